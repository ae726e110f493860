"""A recorded view: what its script in the page needs, and the pictures beside it."""

import ast
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from gsfusion_nb.viz.display import source
from gsfusion_nb.viz.meshes import MeshViewer
from gsfusion_nb.viz.splat_viewer import SplatViewer

STATIC = Path(__file__).parent / "static"
WIDEST_PX = 760
"""Pictures are made narrower than this."""


@dataclass(kw_only=True, eq=False)
class Recorded:
    """One view of a chapter."""

    kind: str
    """Which script shows it: "panel", "stepper", "splat", "mesh", "pixels" or "trace"."""
    data: dict[str, Any]
    """What the script needs, as JSON."""
    words: str
    """What the reader can do with it, a sentence."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Files beside the script, by name."""

    def script(self, name: str) -> bytes:
        """A file that gives the data to the page; a script, because a page opened from a folder may not fetch JSON."""
        return f"gsnbView({json.dumps(name)}, {json.dumps(self.data, ensure_ascii=False)});\n".encode()

    @property
    def size(self) -> int:
        """Bytes of the script."""
        return len(self.script(""))


def placeholder(recorded: Mapping[str, Any], folder: str, cell: str) -> str:
    """HTML of a view before its script runs; the stored picture takes the place of the remark."""
    address = escape(f"{folder}/{cell}.view.js")
    return (
        f'<div class="gsnb-view" data-kind="{recorded["kind"]}" data-name="{escape(cell)}" data-src="{address}" '
        f'data-files="{escape(folder)}/{escape(cell)}/" data-bytes="{recorded["bytes"]}">'
        f'<p class="gsnb-view-words"><b>Live.</b> {escape(recorded["words"])}</p>'
        f'<div class="gsnb-view-stage"><!-- picture --></div></div>'
    )


def needs_kernel(words: str) -> str:
    """HTML of a view that is not recorded: why it shows only a picture."""
    return f'<p class="gsnb-view-words"><b>Needs a kernel.</b> {escape(words)}</p><!-- picture -->'


def webp(picture: np.ndarray, quality: int = 72) -> bytes:
    """A picture as WebP, made narrower if it is too wide. [H, W, 3 or 4] bytes, red first"""
    import cv2

    height, width = picture.shape[:2]
    if width > WIDEST_PX:
        size = (WIDEST_PX, round(height * WIDEST_PX / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    code = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return cv2.imencode(".webp", cv2.cvtColor(picture, code), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()


def needed_cells(cells: Sequence[Mapping[str, Any]], target: str, also: Sequence[str] = ()) -> list[str]:
    """Ids of the code cells to run, in their order, the target last.

    A name is taken from the last cell above that binds it. A cell that only changes a value (``live.run_sync()``) binds
    nothing: name it in ``also``.

    Args:
        cells: Of the notebook.
        target: Id of the cell.
        also: Ids of other cells that must run.

    Raises:
        ValueError: there is no such cell.
    """
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    place = {cell["id"]: k for k, cell in enumerate(code)}
    if missing := [name for name in (target, *also) if name not in place]:
        raise ValueError(f"there is no code cell {', '.join(missing)}")
    names = [_names("".join(cell["source"])) for cell in code]
    wanted: set[int] = set()

    def want(k: int) -> None:
        if k in wanted:
            return
        wanted.add(k)
        for name in names[k][1]:
            binding = next((j for j in range(k - 1, -1, -1) if name in names[j][0]), None)
            if binding is not None:
                want(binding)

    for name in (target, *also):
        want(place[name])
    return [code[k]["id"] for k in sorted(wanted) if k <= place[target]]


def _names(source: str) -> tuple[set[str], set[str]]:
    """Names that a cell binds at its top level, and all that it reads."""
    tree = ast.parse(source)
    bound: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
            continue
        for part in ast.walk(node):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                bound.add(part.id)
            elif isinstance(part, ast.alias):
                bound.add(part.asname or part.name.partition(".")[0])
    read = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}
    return bound, read


_PIXELS = ("pixel_stack.js", "pixel_mix.js", "microscope.js", "mix_microscope.js")
_EXPORT = re.compile(r"^export (?!default)", re.MULTILINE)


def front_ends() -> dict[str, str]:
    """File name -> text of each viewer's script; each gives its ``render`` to ``gsnbFrontEnds``."""
    texts = {
        "splat": SplatViewer._esm,
        "mesh": MeshViewer._esm,
        "stepper": source("steppers/stepper.js"),
        "pixels": _EXPORT.sub("", "".join(map(_own, _PIXELS))),
        "trace": _own("trace.js"),
    }
    return {f"front_{kind}.js": _classic(kind, text) for kind, text in texts.items()}


def _classic(kind: str, text: str) -> str:
    head, mark, tail = text.rpartition("export default ")
    if not mark:
        raise ValueError(f"the script of the {kind} viewer has no default export")
    return f'(() => {{\n"use strict";\n{head}(window.gsnbFrontEnds ??= {{}}).{kind} = {tail}\n}})();\n'


def style_sheet() -> str:
    """The viewers' styles."""
    theirs = ("splats/viewer", "meshes/viewer", "steppers/stepper", "click_image")
    return "\n".join([*(source(f"{name}.css") for name in theirs), _own("views.css")])


def _own(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")


def some(entries: Sequence[Any], most: int) -> list[Any]:
    """At most so many entries, the first and the last among them."""
    every = np.linspace(0, len(entries) - 1, min(len(entries), most)).round().astype(int)
    return [entries[k] for k in every]
