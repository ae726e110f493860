"""Looking at a mesh in a notebook: turned with the mouse where that works, a picture where it does not."""

import math
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_name
from ...drawing.pictures import Picture
from ...types import Camera, Mesh
from ..display import show, static_views
from ..viewpoint import Vector, Viewpoint, extent
from . import opengl as gl
from .decimation import reduced
from .painter import BACKGROUND, draw_mesh

_VIEW_ANGLE_DEG = 30.0
"""From top to bottom of the picture."""
_MOST_PAINTED = 150_000
"""Triangles that are painted one by one without VTK."""


def show_mesh(
    mesh: Mesh,
    *,
    T_WC: Float[Tensor, "4 4"] | None = None,
    up_W: Vector = (0.0, 0.0, 1.0),
    shading: Literal["colour", "shape"] = "colour",
    backend: Literal["auto", "live", "static"] = "auto",
    max_triangles: int = 100_000,
    size: tuple[int, int] = (640, 480),
) -> Any:
    """A view of the mesh; the last line of a cell shows it. Faces seen from behind are hidden, which opens a room.

    Args:
        mesh: What ``mapper.mesh()`` gives.
        T_WC: Where to look from; by default from above, at an angle.
        up_W: What is up.
        shading: "colour" shows the vertex colours, "shape" a grey surface under a lamp.
        backend: "live": turn it with the mouse (``MeshViewer``); "static": a picture; "auto": "live", but "static" in
            ``static_views``.
        max_triangles: That the live view gets, 2 MB for 100,000; of a larger mesh some are merged first.
        size: Width and height, pixels.

    Raises:
        ValueError: the mesh has no triangles. KeyError: no such backend.
    """
    check_name("backend", backend, ("auto", "live", "static"))
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles: nothing was mapped, or no surface was seen closely enough")
    pose = _from_above(mesh, up_W, size) if T_WC is None else T_WC
    if backend == "static" or (backend == "auto" and static_views()):
        return show(mesh_picture(mesh, pose, shading=shading, size=size))
    from .viewer import MeshViewer

    small, up = reduced(mesh, max_triangles), torch.as_tensor(up_W).float()
    return MeshViewer(small, _camera(size), pose, pivot_m=_gaze_m(mesh, pose), up_W=up, shading=shading)


def mesh_picture(
    mesh: Mesh,
    T_WC: Float[Tensor, "4 4"],
    *,
    shading: Literal["colour", "shape"] = "colour",
    size: tuple[int, int] = (640, 480),
) -> Picture:
    """The static view: drawn by VTK where it works, else painted triangle by triangle."""
    if not gl.can_draw()[0]:
        return draw_mesh(reduced(mesh, _MOST_PAINTED), _camera(size), T_WC, shading=shading)
    plotter = _plotter(mesh, T_WC, shading, size)
    try:
        return np.ascontiguousarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def _plotter(mesh: Mesh, T_WC: Tensor, shading: str, size: tuple[int, int]) -> Any:
    gl.prepare()
    import pyvista as pv

    faces = mesh.faces.cpu().numpy()
    surface = pv.PolyData.from_regular_faces(mesh.vertices_W.cpu().numpy(), faces)
    plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
    plotter.add_light(pv.Light(light_type="headlight"))
    plotter.set_background([c / 255 for c in BACKGROUND])  # pyright: ignore[reportArgumentType]
    if shading == "colour":
        surface["rgb"] = (mesh.rgb.cpu().numpy().clip(0, 1) * 255 + 0.5).astype(np.uint8)
        plotter.add_mesh(surface, scalars="rgb", rgb=True, ambient=0.8, diffuse=0.25, culling="back")
    else:
        plotter.add_mesh(surface, color="#e6e6e6", ambient=0.2, diffuse=0.8, smooth_shading=False, culling="back")
    T = T_WC.detach().cpu().double().numpy()
    plotter.camera.position = T[:3, 3]
    plotter.camera.focal_point = T[:3, 3] + T[:3, 2] * _gaze_m(mesh, T_WC)
    plotter.camera.up = -T[:3, 1]
    plotter.camera.view_angle = _VIEW_ANGLE_DEG
    plotter.reset_camera_clipping_range()
    return plotter


def _gaze_m(mesh: Mesh, T_WC: Tensor) -> float:
    """How far ahead the mouse's centre of rotation lies."""
    centre_W, radius_m = extent(mesh.vertices_W)
    ahead = float((centre_W - T_WC[:3, 3].cpu()) @ T_WC[:3, 2].cpu())
    return max(ahead, 0.3 * radius_m)


def _from_above(mesh: Mesh, up_W: Vector, size: tuple[int, int]) -> Tensor:
    centre_W, radius_m = extent(mesh.vertices_W)
    x, y, z = centre_W.tolist()
    camera = _camera(size)
    distance_m = 2.0 * radius_m * camera.fx / min(size)
    view = Viewpoint(target_W=(x, y, z), azimuth_deg=-60.0, elevation_deg=50.0, distance_m=distance_m)
    return view.pose(up_W)


def _camera(size: tuple[int, int]) -> Camera:
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(_VIEW_ANGLE_DEG / 2))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
