"""Pictures, live views and players for notebooks. ipywidgets, pyvista and matplotlib load when used."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .display import show as show
    from .display import static_views as static_views
    from .filling import fill_panel as fill_panel
    from .gaussian_picture import draw as draw
    from .gradient_microscope import GradientMicroscope as GradientMicroscope
    from .live import LiveMapper as LiveMapper
    from .mesh_view import show_mesh as show_mesh
    from .orbit import OrbitView as OrbitView
    from .orbit import orbit_view as orbit_view
    from .pixel_microscope import PixelMicroscope as PixelMicroscope
    from .player import Player as Player
    from .point_view import point_panel as point_panel
    from .quadtree_view import quadtree_panel as quadtree_panel
    from .splat_viewer import SplatViewer as SplatViewer
    from .tsdf_slice import slice_picture as slice_picture
    from .viewpoint import orbit_camera as orbit_camera
    from .watch import Watch as Watch

_LAZY = {
    "GradientMicroscope": "gradient_microscope",
    "LiveMapper": "live",
    "OrbitView": "orbit",
    "PixelMicroscope": "pixel_microscope",
    "Player": "player",
    "SplatViewer": "splat_viewer",
    "Watch": "watch",
    "draw": "gaussian_picture",
    "fill_panel": "filling",
    "orbit_camera": "viewpoint",
    "orbit_view": "orbit",
    "point_panel": "point_view",
    "quadtree_panel": "quadtree_view",
    "show": "display",
    "show_mesh": "mesh_view",
    "slice_picture": "tsdf_slice",
    "static_views": "display",
}


def __getattr__(name: str):
    if name in _LAZY:
        return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)
    raise AttributeError(f"module 'gsfusion_nb.viz' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *_LAZY])
