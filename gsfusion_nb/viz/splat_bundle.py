"""The front ends of the viewers, each as one text: anywidget takes one module, and a page may load nothing else."""

import functools
import json
import re
from importlib.resources import files

ENGINE = ("splat_rows", "splat_project", "splat_colour", "splat_raster", "splat_engine")
"""The modules of the worker, in the order of their imports; they know no page, so node runs them too."""
PAGE = ("splat_camera", "splat_webgl", "splat_worker", "splat_panel", "splat_mouse", "splat_time", "splat_widget")
"""The modules of the page."""
MESH = ("splat_project", "splat_camera", "splat_mouse", "mesh_raster", "mesh_widget")
"""The modules of the mesh viewer, which turns its camera as the splat viewer does."""

_IMPORT = re.compile(r'^import .* from "\./\w+\.js";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?!default)", re.MULTILINE)


@functools.cache
def source(name: str) -> str:
    """A file of ``static/``."""
    return files("gsfusion_nb.viz").joinpath("static", name).read_text(encoding="utf-8")


def joined(modules: tuple[str, ...]) -> str:
    """Modules one after the other, without the imports and exports between them."""
    return "\n".join(_EXPORT.sub("", _IMPORT.sub("", source(f"{name}.js"))) for name in modules)


@functools.cache
def front_end() -> str:
    """The splat viewer's module. The engine is in it twice: as code for the page, and as text to make a worker from."""
    engine = joined(ENGINE)
    texts = {
        "ENGINE_SOURCE": engine,
        "PANEL_HTML": source("splat.html"),
        "VERTEX": source("splat.vert"),
        "FRAGMENT": source("splat.frag"),
    }
    constants = "\n".join(f"const {name} = {json.dumps(text)};" for name, text in texts.items())
    return f"{engine}\n{constants}\n{joined(PAGE)}"


@functools.cache
def mesh_front_end() -> str:
    """The mesh viewer's module."""
    return f"const MESH_HTML = {json.dumps(source('mesh.html'))};\n{joined(MESH)}"
