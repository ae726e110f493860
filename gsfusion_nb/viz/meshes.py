"""A mesh in a notebook: a widget that is turned with the mouse, and a picture drawn by pyvista."""

import functools
import math
import os
import subprocess
import sys
from typing import Any, Literal

import anywidget
import numpy as np
import torch
import traitlets as t
from jaxtyping import Float
from torch import Tensor

from ..checks import check_name, check_pose
from ..drawing.pictures import Picture, to_uint8
from ..types import Camera, Mesh
from .display import front_end, show, source, static_views, synced, with_picture
from .viewpoint import Vector, extent, orbit_camera

BACKGROUND = (245, 246, 248)
_VIEW_ANGLE_DEG = 30.0
"""Vertical angle of view."""
FINE = ("meshes/raster", "meshes/fine")
"""JavaScript modules of the worker."""
PAGE = ("lost", "projection", "camera", "mouse", "meshes/widget")
"""JavaScript modules of the page; its camera moves as in the splat viewer."""
_PROBE = (
    "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(16, 16)); "
    "p.add_mesh(pv.Sphere()); assert p.screenshot(return_img=True).shape[:2] == (16, 16)"
)


def mesh_picture(
    mesh: Mesh, camera: Camera, T_WC: Float[Tensor, "4 4"], *, shading: Literal["colour", "shape"] = "colour"
) -> Picture:
    """The mesh seen by a camera; faces seen from behind are left out, so that one can look into a closed room.

    Args:
        mesh: Any mesh; one without triangles gives the background.
        camera: Its size and its vertical angle of view count; the principal point is taken as the middle.
        T_WC: Camera-to-world pose.
        shading: "colour" shows the vertex colours, "shape" a grey surface under a lamp.

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

    plotter = pv.Plotter(off_screen=True, window_size=[camera.width, camera.height], lighting="none")
    plotter.add_light(pv.Light(light_type="headlight"))
    plotter.set_background([c / 255 for c in BACKGROUND])  # pyright: ignore[reportArgumentType]
    if len(mesh.faces):
        surface = pv.PolyData.from_regular_faces(mesh.vertices_W.cpu().numpy(), mesh.faces.cpu().numpy())
        if shading == "colour":
            surface["rgb"] = to_uint8(mesh.rgb[None])[0]
            plotter.add_mesh(surface, scalars="rgb", rgb=True, ambient=0.7, diffuse=0.3, culling="back")
        else:
            plotter.add_mesh(surface, color="#e6e6e6", ambient=0.2, diffuse=0.8, smooth_shading=False, culling="back")
    T = T_WC.detach().cpu().double().numpy()
    plotter.camera.position = T[:3, 3]
    plotter.camera.focal_point = T[:3, 3] + T[:3, 2] * gaze_m(mesh, T_WC)
    plotter.camera.up = -T[:3, 1]
    plotter.camera.view_angle = math.degrees(2 * math.atan(0.5 * camera.height / camera.fy))
    plotter.reset_camera_clipping_range()
    return plotter


def mesh_camera(size: tuple[int, int]) -> Camera:
    """A camera with a vertical angle of view of 30 degrees, for a picture of ``size`` (width, height)."""
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(_VIEW_ANGLE_DEG / 2))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def gaze_m(mesh: Mesh, T_WC: Tensor) -> float:
    """Distance from the camera to the point that the mouse turns it around, metres."""
    centre_W, radius_m = extent(mesh.vertices_W)
    ahead = float((centre_W - T_WC[:3, 3].cpu()) @ T_WC[:3, 2].cpu())
    return max(ahead, 0.3 * radius_m)


@functools.cache
def can_draw() -> tuple[bool, str]:
    """Whether a pyvista ``Plotter`` works on this machine, and the reason if not.

    On a machine with neither libgl1 nor libegl1 creating one ends the process with a segmentation fault that no ``try``
    catches, so it is tried once in a process of its own. The environment variable GSNB_VTK=ok or none skips the trial.
    """
    headless = not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if sys.platform == "linux" and headless:  # rather than search for an X server
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    forced = os.environ.get("GSNB_VTK")
    if forced in ("ok", "none"):
        return forced == "ok", f"GSNB_VTK={forced}"
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return False, "VTK took over 60 s for a trial picture of 16x16 pixels"
    if done.returncode == 0:
        return True, "ok"
    if done.returncode < 0:
        return False, "VTK crashed; on Debian or Ubuntu: apt-get install -y --no-install-recommends libgl1 libegl1"
    return False, (done.stderr.strip().splitlines() or ["unknown error"])[-1]


def decimated(mesh: Mesh, max_triangles: int) -> Mesh:
    """The mesh with at most ``max_triangles``, by vertex clustering (Rossignac & Borrel 1993).

    The cell size follows from the surface's area and is widened until the count fits. Position and colour of a cluster
    are the means of its vertices. Evenly sized triangles keep colours better than fewer triangles on flat walls would.

    Args:
        mesh: Any mesh; returned as it is when small enough.
        max_triangles: Limit, >= 1.
    """
    if max_triangles < 1:
        raise ValueError(f"max_triangles must be >= 1, got {max_triangles}")
    if len(mesh.faces) <= max_triangles:
        return mesh
    corners = mesh.vertices_W[mesh.faces]
    area_m2 = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum() / 2
    cell_m = float((2 * area_m2 / max_triangles).sqrt().clamp_min(1e-9))  # a grid of squares has two triangles in each
    smaller = mesh
    while len(smaller.faces) > max_triangles:
        smaller = _clustered(mesh, cell_m)
        cell_m *= 1.05 * max(len(smaller.faces) / max_triangles, 1.0) ** 0.5
    return smaller


def _clustered(mesh: Mesh, cell_m: float) -> Mesh:
    low = mesh.vertices_W.amin(0)
    key = ((mesh.vertices_W - low) / cell_m).floor().to(torch.int64)
    span = key.amax(0) + 1
    _, cluster = torch.unique((key[:, 0] * span[1] + key[:, 1]) * span[2] + key[:, 2], return_inverse=True)
    n = int(cluster.max()) + 1
    count = torch.bincount(cluster, minlength=n)[:, None]

    def mean(values: Float[Tensor, "V 3"]) -> Float[Tensor, "N 3"]:
        return values.new_zeros(n, 3).index_add_(0, cluster, values) / count

    faces = cluster[mesh.faces]
    a, b, c = faces.unbind(1)
    faces = faces[(a != b) & (b != c) & (c != a)]
    first = faces.argmin(1, keepdim=True)
    turned = faces.gather(1, (first + torch.arange(3, device=faces.device)) % 3)  # same triangle, same row
    return Mesh(vertices_W=mean(mesh.vertices_W), faces=torch.unique(turned, dim=0), rgb=mean(mesh.rgb))


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

    return MeshViewer(small, mesh_camera(size), pose, pivot_m=gaze_m(mesh, pose), up_W=up, shading=shading)


def _from_above(mesh: Mesh, up_W: Vector, size: tuple[int, int]) -> Tensor:
    centre_W, radius_m = extent(mesh.vertices_W)
    x, y, z = centre_W.tolist()
    camera = mesh_camera(size)
    distance_m = 2.0 * radius_m * camera.fx / min(size)
    return orbit_camera((x, y, z), -60.0, 50.0, distance_m, up_W)


class MeshViewer(anywidget.AnyWidget):
    """Look at a mesh from every side; the last line of a cell shows it. Faces seen from behind are hidden.

    Drag to orbit, shift-drag to pan, ctrl-drag to look around, wheel (after a click) to zoom, double-click to turn
    around a point, R to reset. ``viewer.T_WC`` is the camera's pose. The mesh is sent as one binary message and is not
    part of the widget's state, so a saved notebook holds a picture and not the mesh.

    Args:
        mesh: With at least one triangle; about 100,000 are drawn at 30 pictures a second.
        camera: Intrinsics of the view, and the size of the canvas.
        T_WC: Camera-to-world pose to start from.
        pivot_m: Distance from the camera to the point that the mouse turns it around, metres.
        up_W: The world's up direction. [3]
        shading: "colour" shows the vertex colours, "shape" a grey surface under a lamp; may be changed later.
    """

    _esm = front_end(FINE, PAGE, "FINE_SOURCE", {"MESH_HTML": "meshes/viewer.html"})
    _css = source("meshes/viewer.css")

    width = synced(t.Int())
    height = synced(t.Int())
    intrinsics = synced(t.List(t.Float()))
    home = synced(t.List(t.Float()))
    pose = synced(t.List(t.Float()))
    pivot_m = synced(t.Float())
    up_W = synced(t.List(t.Float()))
    background = synced(t.List(t.Int(), list(BACKGROUND)))
    shading = synced(t.Enum(("colour", "shape"), "colour"))
    stats = synced(t.Dict())

    def __init__(
        self,
        mesh: Mesh,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        *,
        pivot_m: float | int,
        up_W: Float[Tensor, "3"],
        shading: Literal["colour", "shape"] = "colour",
    ):
        check_pose("T_WC", T_WC)
        self.mesh, self.camera = mesh, camera
        start = T_WC.detach().cpu().float().flatten().tolist()
        super().__init__(
            width=camera.width, height=camera.height, intrinsics=[camera.fx, camera.fy, camera.cx, camera.cy],
            home=start, pose=start, pivot_m=float(pivot_m), up_W=(up_W / up_W.norm()).tolist(), shading=shading,
        )  # fmt: skip
        self.on_msg(self._heard)

    @property
    def T_WC(self) -> Float[Tensor, "4 4"]:
        """The camera's present pose; assign a pose to move it."""
        return torch.tensor(self.pose).view(4, 4)

    @T_WC.setter
    def T_WC(self, T_WC: Float[Tensor, "4 4"]) -> None:
        check_pose("T_WC", T_WC)
        self.pose = T_WC.flatten().tolist()

    def picture(self) -> Picture:
        """What the viewer shows, drawn in Python. Raises as ``mesh_picture``."""
        return mesh_picture(self.mesh, self.camera, self.T_WC, shading=self.shading)

    def __repr__(self) -> str:
        return f"MeshViewer({len(self.mesh.faces):,} triangles, {self.width}x{self.height})"

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        live: Any = super()._repr_mimebundle_(**kwargs)
        bundle = live[0] if isinstance(live, tuple) else live
        if not can_draw()[0]:
            return {**(bundle or {}), "text/plain": f"{self!r}, without a picture: {can_draw()[1]}"}, {}
        return with_picture(bundle, self.picture(), repr(self), alt=f"A mesh of {len(self.mesh.faces):,} triangles")

    def _heard(self, _widget: Any, content: Any, _buffers: Any) -> None:
        """The front end has opened: send the mesh."""
        if content.get("kind") != "ready":
            return
        rgb = to_uint8(self.mesh.rgb[None])[0]
        arrays = [self.mesh.vertices_W.cpu().numpy(), self.mesh.faces.int().cpu().numpy(), rgb]
        self.send({"kind": "mesh"}, [np.ascontiguousarray(a).tobytes() for a in arrays])
