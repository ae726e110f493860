"""The JavaScript of each viewer, joined to one text: anywidget takes one module, and a page may load nothing else."""

import functools
import json
import re
from importlib.resources import files

ENGINE = ("splats/rows", "projection", "splats/colour", "splats/raster", "splats/engine")
"""Modules of the splat viewer's worker, in the order of their imports; without a page, so that node runs them too."""
SPLAT_PAGE = (
    "lost",
    "camera",
    "splats/webgl",
    "splats/worker",
    "splats/panel",
    "mouse",
    "splats/time",
    "splats/widget",
)
"""The modules of the splat viewer's page."""
FINE = ("meshes/raster", "meshes/fine")
"""Modules of the mesh viewer's worker; without a page, so that node runs them too."""
MESH_PAGE = ("lost", "projection", "camera", "mouse", "meshes/widget")
"""The modules of the mesh viewer's page; its camera moves as in the splat viewer."""

_IMPORT = re.compile(r'^import .* from "[./\w]+\.js";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?!default)", re.MULTILINE)


@functools.cache
def source(name: str) -> str:
    """The text of ``WING/static/FILE``, for the name "WING/FILE"; of ``static/FILE`` for the name "FILE"."""
    *wing, file = name.split("/")
    return files("gsfusion_nb.viz").joinpath(*wing, "static", file).read_text(encoding="utf-8")


def joined(modules: tuple[str, ...]) -> str:
    """Modules one after the other, without the imports and exports between them."""
    return "\n".join(_EXPORT.sub("", _IMPORT.sub("", source(f"{name}.js"))) for name in modules)


@functools.cache
def splat_front_end() -> str:
    """The splat viewer's module. It holds the engine twice: as code for the page, and as text to make a worker from."""
    engine = joined(ENGINE)
    texts = {
        "ENGINE_SOURCE": engine,
        "PANEL_HTML": source("splats/viewer.html"),
        "VERTEX": source("splats/splat.vert"),
        "FRAGMENT": source("splats/splat.frag"),
    }
    constants = "\n".join(f"const {name} = {json.dumps(text)};" for name, text in texts.items())
    return f"{engine}\n{constants}\n{joined(SPLAT_PAGE)}"


@functools.cache
def mesh_front_end() -> str:
    """The mesh viewer's module. It holds the painter twice: as code for the page, and as text to make a worker from."""
    fine = joined(FINE)
    texts = {"FINE_SOURCE": fine, "MESH_HTML": source("meshes/viewer.html")}
    constants = "\n".join(f"const {name} = {json.dumps(text)};" for name, text in texts.items())
    return f"{fine}\n{constants}\n{joined(MESH_PAGE)}"
