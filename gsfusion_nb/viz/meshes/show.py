"""A mesh in a notebook: a widget that is turned with the mouse, or a picture in notebooks that are stored.

pyvista draws the pictures, but not the widget: its interactive views need OpenGL, in the kernel or in the browser, and
a running kernel or a page of several megabytes. The widget needs neither a graphics card nor a download.
"""

from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_name
from ...types import Mesh
from ..display import show, static_views
from ..viewpoint import Vector, Viewpoint, extent
from .picture import decimated, gaze_m, mesh_camera, mesh_picture


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
    """A view of the mesh; the last line of a cell shows it. Faces seen from behind are hidden: one can see into a room.

    Args:
        mesh: What ``mapper.mesh()`` gives.
        T_WC: Camera-to-world pose to look from; by default from above, at an angle.
        up_W: The world's up direction.
        shading: "colour" shows the vertex colours, "shape" a grey surface under a lamp.
        backend: "live": turn it with the mouse (``MeshViewer``); "static": a picture; "auto": "live", but "static" if
            ``static_views()``.
        max_triangles: Most triangles of the live view (100,000 are 2 MB); a larger mesh is simplified first.
        size: Width and height, pixels.

    Raises:
        ValueError: the mesh has no triangles. KeyError: no such backend. RuntimeError: a picture, and VTK cannot draw.
    """
    check_name("backend", backend, ("auto", "live", "static"))
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles: nothing was mapped, or no surface was seen closely enough")
    pose = _from_above(mesh, up_W, size) if T_WC is None else T_WC
    if backend == "static" or (backend == "auto" and static_views()):
        return show(mesh_picture(mesh, mesh_camera(size), pose, shading=shading))
    small, up = decimated(mesh, max_triangles), torch.as_tensor(up_W).float()
    from .viewer import MeshViewer

    return MeshViewer(small, mesh_camera(size), pose, pivot_m=gaze_m(mesh, pose), up_W=up, shading=shading)


def _from_above(mesh: Mesh, up_W: Vector, size: tuple[int, int]) -> Tensor:
    centre_W, radius_m = extent(mesh.vertices_W)
    x, y, z = centre_W.tolist()
    camera = mesh_camera(size)
    distance_m = 2.0 * radius_m * camera.fx / min(size)
    view = Viewpoint(target_W=(x, y, z), azimuth_deg=-60.0, elevation_deg=50.0, distance_m=distance_m)
    return view.pose(up_W)
