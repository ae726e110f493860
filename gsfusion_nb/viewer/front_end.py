"""JavaScript of the package as text: one module for a widget, or for a page that loads nothing."""

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files

_IMPORT = re.compile(r'^import .* from "[./\w]+\.js";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?!default)", re.MULTILINE)
ROOM = "viewer"

ENGINE = ("splats/rows", "projection", "splats/colour", "splats/raster", "splats/engine")
"""JavaScript modules of the splat viewer's worker."""
PAGE = (
    "lost",
    "camera",
    "splats/webgl",
    "splats/worker",
    "splats/panel",
    "mouse",
    "splats/time",
    "splats/widget",
)
"""JavaScript modules of the splat viewer's page."""
_TEXTS = {
    "PANEL_HTML": "splats/viewer.html",
    "VERTEX": "splats/splat.vert",
    "FRAGMENT": "splats/splat.frag",
}
"""Constant of the splat viewer -> the file that it holds."""


def source(room: str, name: str) -> str:
    """The text of ``static/NAME`` in a room of the package."""
    folder = files(f"gsfusion_nb.{room}")
    return folder.joinpath("static", *name.split("/")).read_text(encoding="utf-8")


def join_modules(modules: Sequence[tuple[str, str]]) -> str:
    """JavaScript modules, as room and name, one after the other, without the imports and exports
    between them.

    anywidget takes one module, and a page may load nothing else.
    """
    texts = (source(room, f"{name}.js") for room, name in modules)
    return "\n".join(_EXPORT.sub("", _IMPORT.sub("", text)) for text in texts)


def viewer_modules(names: Sequence[str]) -> str:
    """Modules of this room, joined."""
    return join_modules([(ROOM, name) for name in names])


def front_end(
    worker: Sequence[str],
    page: Sequence[str],
    worker_name: str,
    texts: Mapping[str, str],
) -> str:
    """The module of a viewer that computes in a worker.

    Args:
        worker: Modules of the worker, in the order of their imports; without a page, so that node
            runs them too.
        page: Modules of the page.
        worker_name: Constant that holds the worker's text; its code is also in the page, for where
            none is allowed.
        texts: Constant -> name of a file that it holds.
    """
    code = viewer_modules(worker)
    files_in_it = {name: source(ROOM, file) for name, file in texts.items()}
    constants = {worker_name: code, **files_in_it}
    lines = "\n".join(f"const {name} = {json.dumps(text)};" for name, text in constants.items())
    return f"{code}\n{lines}\n{viewer_modules(page)}"


def splat_module() -> str:
    """The splat viewer as one module, whose default export is an anywidget."""
    return front_end(ENGINE, PAGE, "ENGINE_SOURCE", _TEXTS)


def splat_style() -> str:
    """The splat viewer's style sheet."""
    return source(ROOM, "splats/viewer.css")
