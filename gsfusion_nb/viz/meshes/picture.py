"""A mesh as a picture, drawn by pyvista; where it is not installed or VTK cannot draw, by our own depth buffer."""

import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import Picture, to_uint8
from ...types import Camera, Mesh
from ..viewpoint import extent
from . import opengl
from .painter import BACKGROUND, draw_mesh

_VIEW_ANGLE_DEG = 30.0
"""Vertical angle of view."""


def mesh_picture(
    mesh: Mesh,
    T_WC: Float[Tensor, "4 4"],
    *,
    shading: Literal["colour", "shape"] = "colour",
    size: tuple[int, int] = (640, 480),
) -> Picture:
    """The mesh seen from a pose, by a camera with a vertical angle of view of 30 degrees.

    Args:
        mesh: With at least one triangle.
        T_WC: Camera-to-world pose.
        shading: "colour" shows the vertex colours, "shape" a grey surface under a lamp.
        size: Width and height, pixels.
    """
    if not opengl.can_draw()[0]:
        return draw_mesh(mesh, mesh_camera(size), T_WC, shading=shading)
    plotter = _plotter(mesh, T_WC, shading, size)
    try:
        return np.ascontiguousarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def _plotter(mesh: Mesh, T_WC: Tensor, shading: str, size: tuple[int, int]) -> Any:
    opengl.prepare()
    import pyvista as pv

    faces = mesh.faces.cpu().numpy()
    surface = pv.PolyData.from_regular_faces(mesh.vertices_W.cpu().numpy(), faces)
    plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
    plotter.add_light(pv.Light(light_type="headlight"))
    plotter.set_background([c / 255 for c in BACKGROUND])  # pyright: ignore[reportArgumentType]
    if shading == "colour":
        surface["rgb"] = to_uint8(mesh.rgb[None])[0]
        plotter.add_mesh(surface, scalars="rgb", rgb=True, ambient=0.7, diffuse=0.3, culling="back")
    else:
        plotter.add_mesh(surface, color="#e6e6e6", ambient=0.2, diffuse=0.8, smooth_shading=False, culling="back")
    T = T_WC.detach().cpu().double().numpy()
    plotter.camera.position = T[:3, 3]
    plotter.camera.focal_point = T[:3, 3] + T[:3, 2] * gaze_m(mesh, T_WC)
    plotter.camera.up = -T[:3, 1]
    plotter.camera.view_angle = _VIEW_ANGLE_DEG
    plotter.reset_camera_clipping_range()
    return plotter


def mesh_camera(size: tuple[int, int]) -> Camera:
    """The camera of ``mesh_picture``, with which the widget also starts."""
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(_VIEW_ANGLE_DEG / 2))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def gaze_m(mesh: Mesh, T_WC: Tensor) -> float:
    """Distance from the camera to the point that the mouse turns it around, metres."""
    centre_W, radius_m = extent(mesh.vertices_W)
    ahead = float((centre_W - T_WC[:3, 3].cpu()) @ T_WC[:3, 2].cpu())
    return max(ahead, 0.3 * radius_m)
