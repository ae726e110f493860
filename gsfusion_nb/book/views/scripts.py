"""The scripts of the viewers, as scripts that a page loads from a folder: there, modules cannot be loaded."""

import re
from importlib.resources import files

from ...viz.front_end import mesh_front_end, source, splat_front_end

_PIXELS = ("pixel_stack.js", "pixel_mix.js", "microscope.js", "mix_microscope.js")
_EXPORT = re.compile(r"^export (?!default)", re.MULTILINE)


def front_ends() -> dict[str, str]:
    """File name -> text of each viewer's script; each gives its ``render`` to ``gsnbFrontEnds``."""
    texts = {
        "splat": splat_front_end(),
        "mesh": mesh_front_end(),
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
    theirs = ("splats/viewer", "meshes/viewer", "steppers/stepper", "panels/click_image")
    return "\n".join([*(source(f"{name}.css") for name in theirs), _own("views.css")])


def _own(name: str) -> str:
    return files("gsfusion_nb.book").joinpath("static", name).read_text(encoding="utf-8")
