"""Records the views of one chapter: ``python -m book.record NOTEBOOK VIEWS.toml OUT``.

The cells that a view needs are run as the notebook runs them, in this process, and the value of the view's own cell is
recorded. For each view: ``OUT/CELL.view.js``, its pictures in ``OUT/CELL/``, and an entry of ``OUT/views.json``.
"""

import argparse
import ast
import contextlib
import hashlib
import io
import json
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any

from gsfusion_nb.files import read_object

from .recorded import Recorded, needed_cells, needs_kernel, placeholder
from .recorders import record


def wanted_views(path: Path, chapter: str) -> dict[str, dict[str, Any]]:
    """Id of a cell -> how its view is recorded, for one chapter ("03")."""
    return {cell: how for cell, how in _listed(path, chapter).items() if "kernel" not in how}


def kernel_views(path: Path, chapter: str) -> dict[str, str]:
    """Id of a cell -> why its view needs a kernel, for one chapter."""
    return {cell: how["kernel"] for cell, how in _listed(path, chapter).items() if "kernel" in how}


def _listed(path: Path, chapter: str) -> dict[str, dict[str, Any]]:
    return tomllib.loads(path.read_text(encoding="utf-8")).get(f"chapter_{chapter}", {})


def cells_to_run(notebook: Mapping[str, Any], wanted: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Id and source of every cell that must run, in their order, changed as the views ask."""
    cells = notebook["cells"]
    needed = {name for cell, how in wanted.items() for name in needed_cells(cells, cell, how.get("also", ()))}
    changes = {old: new for how in wanted.values() for old, new in how.get("change", {}).items()}
    found = []
    for cell in cells:
        if cell["id"] in needed and cell["cell_type"] == "code":
            source = "".join(cell["source"])
            for old, new in changes.items():
                source = source.replace(old, new)
            found.append((cell["id"], source))
    return found


def run(cells: Sequence[tuple[str, str]], names: dict[str, Any], targets: Mapping[str, Any]) -> dict[str, Recorded]:
    """Run cells one after the other, and record the values of some of them as soon as they are there."""
    found = {}
    for cell, source in cells:
        tree = ast.parse(source)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, cell, "exec"), names)
        value = eval(compile(ast.Expression(last.value), cell, "eval"), names) if isinstance(last, ast.Expr) else None
        if cell in targets:
            found[cell] = record(value, targets[cell].get("grids", ()))
            found[cell].words += f" {targets[cell]['note']}" if "note" in targets[cell] else ""
    return found


def write(found: Mapping[str, Recorded], out: Path) -> None:
    """Write the views of a chapter into an empty folder."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    listed = {}
    for cell, view in found.items():
        script = view.script(cell)
        (out / f"{cell}.view.js").write_bytes(script)
        for name, picture in view.pictures.items():
            (out / cell).mkdir(exist_ok=True)
            (out / cell / name).write_bytes(picture)
        listed[cell] = {"kind": view.kind, "words": view.words, "bytes": len(script)}
    (out / "views.json").write_text(json.dumps(listed, indent=1), encoding="utf-8")


def main() -> int:
    """Record one chapter."""
    parser = argparse.ArgumentParser(description="Records the live views of a chapter.")
    parser.add_argument("notebook", type=Path)
    parser.add_argument("views", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    wanted = wanted_views(options.views, options.notebook.name[:2])
    cells = cells_to_run(read_object(options.notebook, "a notebook"), wanted)
    out, here, began = options.out.resolve(), Path.cwd(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        os.environ["GSNB_COURSE_FILE"] = f"{folder}/course.json"
        os.environ.pop("GSNB_VIEW", None)
        os.chdir(folder)
        found = run(cells, {"__name__": "__main__"}, wanted)
        os.chdir(here)
    write(found, out)
    sys.stderr.write(f"{options.notebook.name}: {len(found)} views, {time.monotonic() - began:.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())


log = logging.getLogger(__name__)

Listed = dict[str, dict[str, dict[str, Any]]]
"""Name of a notebook -> id of a cell -> kind, words and size of its view."""


def record_all(notebooks: Iterable[Path], views: Path, out: Path, *, jobs: int = 2) -> Listed:
    """Record the views of some chapters.

    Args:
        notebooks: Their files.
        views: ``views.toml``.
        out: Folder with a folder for each chapter, kept between builds.
        jobs: Processes at the same time.

    Raises:
        RuntimeError: a view could not be recorded; the message has the last lines of the process.
    """
    package = _fingerprint()

    def one(notebook: Path) -> tuple[str, dict[str, Any]]:
        folder = out / notebook.stem
        wanted = wanted_views(views, notebook.name[:2])
        still = {cell: {"kernel": why} for cell, why in kernel_views(views, notebook.name[:2]).items()}
        if not wanted:
            return notebook.name, still
        asked = json.dumps([package, wanted, cells_to_run(read_object(notebook, "a notebook"), wanted)])
        key = hashlib.sha256(asked.encode()).hexdigest()
        mark = folder / "key"
        if not mark.exists() or mark.read_text() != key:
            _record(notebook, views, folder)
            mark.write_text(key)
        return notebook.name, {**json.loads((folder / "views.json").read_text(encoding="utf-8")), **still}

    with ThreadPoolExecutor(jobs) as pool:
        return dict(pool.map(one, notebooks))


def _record(notebook: Path, views: Path, folder: Path) -> None:
    command = [sys.executable, "-m", "book.record", *map(str, (notebook, views, folder))]
    paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    done = subprocess.run(command, env=environment, text=True, stderr=subprocess.PIPE)
    if done.returncode:
        last = "\n".join(done.stderr.splitlines()[-12:])
        raise RuntimeError(f"the views of {notebook.name} could not be recorded ({views}):\n{last}")
    log.info("%s", done.stderr.strip().splitlines()[-1])


def _fingerprint() -> str:
    """Of the package's code and of the recorders: what a view shows depends on it."""
    root = Path(str(files("gsfusion_nb")))
    found = hashlib.sha256()
    own = [Path(__file__).with_name(name) for name in ("record.py", "recorded.py", "recorders.py")]
    for path in sorted([*root.rglob("*.py"), *root.parent.joinpath("kernels").rglob("*.py"), *own]):
        found.update(path.relative_to(root.parent).as_posix().encode() + path.read_bytes())
    return found.hexdigest()


def put_views(listed: Listed, recorded: Path, extra: Path) -> None:
    """Link or copy the files of the views to where the pages look for them."""
    for notebook, cells in listed.items():
        stem = Path(notebook).stem
        for source in (recorded / stem).rglob("*") if any("kind" in cell for cell in cells.values()) else ():
            if source.is_file() and source.name not in ("key", "views.json"):
                target = extra / "notebooks" / f"{stem}_files" / source.relative_to(recorded / stem)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())


def view_html(listed: Listed, page: str, cell: str) -> str | None:
    """HTML of a view that was recorded, or needs a kernel, for ``Chapter``."""
    notebook = page.rpartition("/")[2]
    found = listed.get(notebook, {}).get(cell)
    if found is None:
        return None
    return (
        needs_kernel(found["kernel"]) if "kernel" in found else placeholder(found, f"{Path(notebook).stem}_files", cell)
    )
