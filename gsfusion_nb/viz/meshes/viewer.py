"""A mesh in a notebook cell, turned with the mouse; the browser draws it without a graphics card or any download."""

from typing import Any, Literal

import anywidget
import numpy as np
import torch
import traitlets as t
from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose
from ...drawing.pictures import Picture, to_uint8
from ...types import Camera, Mesh
from ..display import with_picture
from ..front_end import mesh_front_end, source
from .picture import BACKGROUND, can_draw, mesh_picture


def _synced(trait: t.TraitType) -> Any:
    return trait.tag(sync=True)


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

    _esm = mesh_front_end()
    _css = source("meshes/viewer.css")

    width = _synced(t.Int())
    height = _synced(t.Int())
    intrinsics = _synced(t.List(t.Float()))
    home = _synced(t.List(t.Float()))
    pose = _synced(t.List(t.Float()))
    pivot_m = _synced(t.Float())
    up_W = _synced(t.List(t.Float()))
    background = _synced(t.List(t.Int(), list(BACKGROUND)))
    shading = _synced(t.Enum(("colour", "shape"), "colour"))
    stats = _synced(t.Dict())

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
