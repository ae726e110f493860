"""A panel that moves a camera through a scene and fuses its depth images into a TSDF volume."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import LABEL_PX, Picture, side_by_side, to_uint8
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Camera, Frame
from .click_image import Stroke
from .handles import Point, draw_handles, nearest_handle
from .panel import Choice, Drawn, Panel, Slider, Switch
from .tsdf_slice import (
    LEGEND_PX,
    QUANTITIES,
    X_M,
    Y_M,
    draw_camera,
    slice_legend,
    slice_picture,
    slice_pixel,
    slice_place,
)

DepthSensor = Callable[[Float[Tensor, "4 4"]], Frame]
"""Takes a frame at a camera-to-world pose."""
ARM_M = 0.9
"""Distance from the camera in the slice to the handle that turns it, metres."""


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


def shape_picture(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Picture:
    """The surface in the volume under a lamp at the camera; black where none has been measured."""
    surface = raycast(volume, camera, T_WC)
    lamp = -(surface.normal_W @ T_WC[:3, 2]).clamp(-1, 0)
    return to_uint8(lamp[..., None].expand(-1, -1, 3))


def _joined(
    flat: Picture, view: Picture, camera: Camera, T_WC: Tensor, height_m: float | int, quantity: str
) -> Picture:
    x, y = T_WC[:2, 3].tolist()
    seen = draw_handles(draw_camera(flat, camera, T_WC), camera_handles(x, y, heading_of(T_WC)))
    left = np.concatenate([seen, slice_legend(quantity, flat.shape[1])])
    title = f"{quantity}, slice at z = {height_m:.2f} m"
    return side_by_side([left, view], [title, "the map, seen from the camera"])


def heading_of(T_WC: Float[Tensor, "4 4"]) -> float:
    """Where a camera looks, counter-clockwise from the world's x axis, degrees."""
    return math.degrees(math.atan2(float(T_WC[1, 2]), float(T_WC[0, 2])))


def camera_handles(x_m: float, y_m: float, heading_deg: float) -> dict[str, Point]:
    """In a slice, pixels: the handle that moves the camera, and the one in front of it that turns it."""
    h = math.radians(heading_deg)
    ahead = (x_m + ARM_M * math.cos(h), y_m + ARM_M * math.sin(h))
    return {"place": slice_pixel(x_m, y_m), "heading": slice_pixel(*ahead)}


def touch_camera(stroke: Stroke, values: dict[str, Any], camera: Camera) -> dict[str, float]:
    """What a drag over the panel's picture changes: a handle in the slice, or the direction of view in the view."""
    du, dv = stroke.moved
    width, height = slice_pixel(X_M[1], Y_M[0])
    if stroke.start[0] >= width:  # the scene in the view, which is as high as slice and legend, follows the pointer
        turn = math.degrees(camera.height / (height + LEGEND_PX) / camera.fx)
        heading = wrapped_deg(values["heading_deg"] + du * turn)
        return {"heading_deg": heading, "tilt_deg": values["tilt_deg"] + dv * turn}
    handles = camera_handles(values["x_m"], values["y_m"], values["heading_deg"])
    held = nearest_handle(handles, (stroke.start[0], stroke.start[1] - LABEL_PX))
    if held is None:
        return {}
    x, y = slice_place(handles[held][0] + du, handles[held][1] + dv)
    if held == "place":
        return {"x_m": x, "y_m": y}
    return {"heading_deg": math.degrees(math.atan2(y - values["y_m"], x - values["x_m"]))}


def wrapped_deg(angle_deg: float) -> float:
    """The same angle in -180..180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def tsdf_fill_panel(
    volume: TsdfVolume, camera: Camera, sensor: DepthSensor, *, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Panel:
    """Move a camera, press *measure*, and see the volume fill. Moving alone does not change the map.

    Drag the camera in the slice, the handle in front of it to turn it, or the view to look around; or use the sliders.

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

    def touch(stroke: Stroke, values: dict[str, Any]) -> dict[str, float]:
        return touch_camera(stroke, values, camera)

    buttons = {"measure": measure, "forget": forget}
    text = "A slice of a TSDF volume with the camera in it, and what the camera sees of the map"
    panel = Panel(draw, _controls(*start), buttons=buttons, name="fill", kind="png", text=text, touch=touch)
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
