"""A mesh in a notebook: a picture drawn by pyvista."""

import functools
import math
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_pose
from ..drawing.pictures import Picture, to_uint8
from ..drawing.shading import NOTHING, shaded
from ..errors import ArgumentError
from ..types import Camera, Mesh
from ..viewer.viewpoint import Vector, extent, orbit_camera
from .display import show

if TYPE_CHECKING:
    from IPython.display import Image

BACKGROUND = tuple(round(255 * channel) for channel in NOTHING)
"""In bytes."""
_VIEW_ANGLE_DEG = 30.0
"""Vertical angle of view."""
_PROBE = (
    "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(16, 16)); "
    "p.add_mesh(pv.Sphere()); assert p.screenshot(return_img=True).shape[:2] == (16, 16)"
)


def mesh_picture(
    mesh: Mesh,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    shading: Literal["colour", "shape"] = "colour",
) -> Picture:
    """The mesh seen by a camera; faces seen from behind are left out, so that one can look into a
    closed room.

    Args:
        mesh: Any mesh; one without triangles gives the background.
        camera: Its size and its vertical angle of view count; the principal point is taken as the
            middle.
        T_WC: Camera-to-world pose.
        shading: "colour" shows the vertex colours, "shape" a grey surface; the lamps
            are those of ``drawing.shading``.

    Raises:
        RuntimeError: VTK cannot draw on this machine; the message says what to install.
    """
    check_pose("T_WC", T_WC)
    able, why = can_draw()
    if not able:
        raise RuntimeError(f"no picture of a mesh: {why}")
    plotter = _plotter(mesh, camera, T_WC, shading)
    try:
        return np.ascontiguousarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def _plotter(mesh: Mesh, camera: Camera, T_WC: Tensor, shading: str) -> Any:
    import pyvista as pv

    plotter = pv.Plotter(
        off_screen=True, window_size=[camera.width, camera.height], lighting="none"
    )
    plotter.set_background(NOTHING)  # pyright: ignore[reportArgumentType]
    if len(mesh.faces):
        surface = pv.PolyData.from_regular_faces(
            mesh.vertices_W.cpu().numpy(), mesh.faces.cpu().numpy()
        )
        values = surface.point_data if shading == "colour" else surface.cell_data
        values["rgb"] = to_uint8(_lit(mesh, T_WC, shading)[None])[0]
        plotter.add_mesh(surface, scalars="rgb", rgb=True, lighting=False, culling="back")
    T = T_WC.detach().cpu().double().numpy()
    plotter.camera.position = T[:3, 3]
    plotter.camera.focal_point = T[:3, 3] + T[:3, 2]
    plotter.camera.up = -T[:3, 1]
    plotter.camera.view_angle = math.degrees(2 * math.atan(0.5 * camera.height / camera.fy))
    plotter.reset_camera_clipping_range()
    return plotter


def _lit(mesh: Mesh, T_WC: Tensor, shading: str) -> Float[Tensor, "_ 3"]:
    """Colour of each vertex, or with "shape" of each triangle, 0..1."""
    corners = mesh.vertices_W.float()[mesh.faces]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to_C = T_WC.to(across)[:3, :3]
    if shading != "colour":
        return shaded(torch.nn.functional.normalize(across, dim=1) @ to_C)
    sums = torch.zeros_like(mesh.vertices_W, dtype=torch.float32)
    for corner in range(3):
        sums.index_add_(0, mesh.faces[:, corner], across)
    return shaded(torch.nn.functional.normalize(sums, dim=1) @ to_C, mesh.rgb.float())


def mesh_camera(size: tuple[int, int]) -> Camera:
    """A camera with a vertical angle of view of 30 degrees, for a picture of ``size`` (width,
    height)."""
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(_VIEW_ANGLE_DEG / 2))
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
    )


@functools.cache
def can_draw() -> tuple[bool, str]:
    """Whether a pyvista ``Plotter`` works on this machine, and the reason if not.

    On a machine with neither libgl1 nor libegl1 creating one ends the process with a segmentation
    fault that no ``try`` catches, so it is tried once in a process of its own. The environment
    variable GSNB_VTK=ok or none skips the trial.
    """
    headless = not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if sys.platform == "linux" and headless:  # rather than search for an X server
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    setting = os.environ.get("GSNB_VTK")
    if setting in ("ok", "none"):
        return setting == "ok", f"GSNB_VTK={setting}"
    try:
        process = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=60
        )
    except subprocess.TimeoutExpired:
        return False, "VTK took over 60 s for a trial picture of 16x16 pixels"
    if process.returncode == 0:
        return True, "ok"
    if process.returncode < 0:
        return (
            False,
            "VTK crashed; on Debian or Ubuntu: apt-get install -y --no-install-recommends libgl1 "
            "libegl1",
        )
    return False, (process.stderr.strip().splitlines() or ["unknown error"])[-1]


def show_mesh(
    mesh: Mesh,
    *,
    T_WC: Float[Tensor, "4 4"] | None = None,
    up_W: Vector = (0.0, 0.0, 1.0),
    shading: Literal["colour", "shape"] = "colour",
    size: tuple[int, int] = (640, 480),
) -> "Image":
    """A picture of the mesh as the output of a cell. Faces seen from behind are hidden: one can see
    into a room.

    Args:
        mesh: What ``mapper.mesh()`` gives.
        T_WC: Camera-to-world pose to look from; by default from above, at an angle.
        up_W: The world's up direction.
        shading: "colour" shows the vertex colours, "shape" a grey surface; the lamps
            are those of ``drawing.shading``.
        size: Width and height, pixels.

    Raises:
        ValueError: the mesh has no triangles. RuntimeError: VTK cannot draw.
    """
    if not len(mesh.faces):
        raise ArgumentError(
            "the mesh has no triangles: nothing was mapped, or no surface was seen closely enough"
        )
    pose = _from_above(mesh, up_W, size) if T_WC is None else T_WC
    look = "in its colours" if shading == "colour" else "as a grey surface"
    place = "" if T_WC is not None else ", seen from above at an angle"
    words = f"A mesh of {len(mesh.faces):,} triangles, {look}{place}"
    return show(mesh_picture(mesh, mesh_camera(size), pose, shading=shading), alt=words)


def _from_above(mesh: Mesh, up_W: Vector, size: tuple[int, int]) -> Tensor:
    centre_W, radius_m = extent(mesh.vertices_W)
    x, y, z = centre_W.tolist()
    camera = mesh_camera(size)
    distance_m = 2.0 * radius_m * camera.fx / min(size)
    return orbit_camera((x, y, z), -60.0, 50.0, distance_m, up_W)
