"""A panel that moves a camera through a scene and fuses its depth images into a TSDF volume."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import Picture, to_uint8
from ...drawing.side_by_side import side_by_side
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Camera, Frame
from .panel import Choice, Drawn, Panel, Slider, Switch
from .tsdf_slice import QUANTITIES, draw_camera, slice_legend, slice_picture

DepthSensor = Callable[[Float[Tensor, "4 4"]], Frame]
"""Takes a frame at a camera-to-world pose."""


def level_pose(
    x_m: float | int, y_m: float | int, height_m: float | int, heading_deg: float | int, tilt_deg: float | int = 0.0
) -> Float[Tensor, "4 4"]:
    """T_WC of an upright camera in a world whose z points up.

    Args:
        x_m, y_m, height_m: Where it stands, metres.
        heading_deg: Where it looks, counter-clockwise from the world's x axis, degrees.
        tilt_deg: Angle above the horizontal, degrees.
    """
    h, t = math.radians(heading_deg), math.radians(tilt_deg)
    forward = [math.cos(h) * math.cos(t), math.sin(h) * math.cos(t), math.sin(t)]
    right = [math.sin(h), -math.cos(h), 0.0]
    down = np.cross(forward, right).tolist()
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.tensor([right, down, forward], dtype=torch.float64).T
    T[:3, 3] = torch.tensor([x_m, y_m, height_m], dtype=torch.float64)
    return T.float()


def fill_picture(
    volume: TsdfVolume,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    height_m: float | int = 1.0,
    quantity: str = "distance",
) -> Picture:
    """A horizontal slice of the volume with the camera on it, beside what the camera sees of the volume.

    The view is shaded by a lamp at the camera; black where no surface has been measured yet.
    """
    flat = slice_picture(volume, height_m=height_m, quantity=quantity)
    return _joined(flat, shape_picture(volume, camera, T_WC), camera, T_WC, height_m, quantity)


def shape_picture(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Picture:
    """The surface in the volume under a lamp at the camera; black where none has been measured."""
    surface = raycast(volume, camera, T_WC)
    lamp = -(surface.normal_W @ T_WC[:3, 2]).clamp(-1, 0)
    return to_uint8(lamp[..., None].expand(-1, -1, 3))


def _joined(
    flat: Picture, view: Picture, camera: Camera, T_WC: Tensor, height_m: float | int, quantity: str
) -> Picture:
    left = np.concatenate([draw_camera(flat, camera, T_WC), slice_legend(quantity, flat.shape[1])])
    title = f"{quantity}, slice at z = {height_m:.2f} m"
    return side_by_side([left, view], [title, "the map, seen from the camera"])


def tsdf_fill_panel(
    volume: TsdfVolume, camera: Camera, sensor: DepthSensor, *, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Panel:
    """Move a camera, press *measure*, and see the volume fill. Moving alone does not change the map.

    Args:
        volume: Filled in place; *forget* empties it.
        camera: Of the preview.
        sensor: Takes a frame at a pose; ``integrate`` fuses it.
        start: x, y in metres, and heading in degrees.
    """
    fused = [0]

    # Each part of the picture is kept until the volume or one of its own controls changes.
    @lru_cache(maxsize=1)
    def flat(_state: tuple[int, float], height_m: float | int, quantity: str) -> Picture:
        return slice_picture(volume, height_m=height_m, quantity=quantity)

    @lru_cache(maxsize=1)
    def shape(_state: tuple[int, float], **where: float | int) -> Picture:
        return shape_picture(volume, camera, pose(where))

    @lru_cache(maxsize=1)
    def observed(_state: tuple[int, float]) -> int:
        return int((volume.W > 0).sum())

    def measured(T_WC: Tensor) -> None:
        integrate(volume, sensor(T_WC))
        fused[0] += 1

    def pose(values: dict[str, Any]) -> Float[Tensor, "4 4"]:
        return level_pose(values["x_m"], values["y_m"], 1.3, values["heading_deg"], values["tilt_deg"])

    def measure() -> None:
        measured(pose(panel.values))

    def forget() -> None:
        volume.load_state_dict(TsdfVolume(volume.config, volume.device).state_dict())
        fused[0] = 0

    def draw(*, height_m: float, quantity: str, at_every_move: bool, **where: float) -> Drawn:
        if at_every_move:
            measured(pose(where))
        now = (volume.n_blocks, float(volume.W.sum()))
        view = shape(now, **where)
        picture = _joined(flat(now, height_m, quantity), view, camera, pose(where), height_m, quantity)
        text = (
            f'<b class="gsnb-fill-frames">{fused[0]}</b> measurements, <b>{volume.n_blocks:,}</b> blocks of 8&sup3; '
            f"voxels, {observed(now):,} voxels observed"
        )
        return picture, text

    buttons = {"measure": measure, "forget": forget}
    panel = Panel(draw, _controls(*start), buttons=buttons, name="fill", kind="png", text="fill panel")
    return panel


def _controls(x_m: float, y_m: float, turn_deg: float) -> dict[str, Slider | Choice | Switch]:
    return {
        "x_m": Slider(value=float(x_m), low=-2.2, high=2.2, step=0.05, label="x, m"),
        "y_m": Slider(value=float(y_m), low=-1.7, high=1.7, step=0.05, label="y, m"),
        "heading_deg": Slider(value=float(turn_deg), low=-180, high=180, step=1.0, label="heading, °", readout=".0f"),
        "tilt_deg": Slider(value=0.0, low=-60, high=60, step=1.0, label="tilt, °", readout=".0f"),
        "height_m": Slider(value=1.0, low=0.0, high=2.6, step=0.02, label="slice at z, m"),
        "quantity": Choice(value="distance", options=QUANTITIES, label="show"),
        "at_every_move": Switch(value=False, label="measure at every move"),
    }
