"""The panels of the chapter on splatting: one Gaussian with sliders, and its view-dependent colour."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ...drawing.ground import CARD_INK
from ...drawing.pictures import Picture
from ...types import Camera
from ..panels.click_image import Stroke
from ..panels.handles import Point, draw_handles, nearest_handle
from ..panels.panel import Drawn, Panel, Slider
from .one_gaussian import gaussian_row, orientation_from_angles, projection_caption, projection_picture, sh_ball

_BALL_PX = 280


def one_gaussian_panel(camera: Camera, *, zoom: int = 6) -> Panel:
    """Move, turn and stretch one Gaussian in front of a camera of few pixels (``projection_picture``).

    Drag its middle, or the end of an axis; with the shift key, up and down move it farther away and nearer. Or use the
    sliders.
    """

    def draw(**values: Any) -> Drawn:
        xyz = torch.tensor([float(values[k]) for k in ("x_m", "y_m", "z_m")])
        scale = torch.tensor([float(values["long_m"]), float(values["thick_m"]), 0.02])
        orientation = orientation_from_angles(values["turn_deg"], values["lean_deg"])
        picture, splats = projection_picture(gaussian_row(xyz, scale, orientation), camera, zoom=zoom)
        return draw_handles(picture, gaussian_handles(values, camera, zoom)), projection_caption(splats)

    def touch(stroke: Stroke, values: dict[str, Any]) -> dict[str, float]:
        return touch_gaussian(stroke, values, camera, zoom)

    controls = {
        "x_m": Slider(value=0.0, low=-1.5, high=1.5, step=0.01, label="x, m"),
        "y_m": Slider(value=0.0, low=-1.5, high=1.5, step=0.01, label="y, m"),
        "z_m": Slider(value=1.5, low=0.3, high=6.0, step=0.1, label="z, m", readout=".1f"),
        "long_m": Slider(value=0.3, low=0.01, high=0.6, step=0.01, label="long axis, m"),
        "thick_m": Slider(value=0.1, low=0.002, high=0.3, step=0.002, label="short axis, m", readout=".3f"),
        "turn_deg": Slider(value=30, low=-180, high=180, step=1, label="turn, °", tip="about the viewing axis"),
        "lean_deg": Slider(value=0, low=-90, high=90, step=1, label="lean, °", tip="about the vertical axis"),
    }
    return Panel(draw, controls, name="one-gaussian", text="One Gaussian and its image", touch=touch)


def gaussian_handles(values: Mapping[str, Any], camera: Camera, zoom: int) -> dict[str, Point]:
    """Middle and ends of the two axes in the enlarged picture, pixels: the axes as EWA projects them."""
    x, y, z = (float(values[k]) for k in ("x_m", "y_m", "z_m"))
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    turn, lean = math.radians(values["turn_deg"]), math.radians(values["lean_deg"])
    long, thick = values["long_m"], values["thick_m"]
    nearer = math.sin(lean) / z  # the end of a leaning axis is nearer to the camera
    ahead = (math.cos(lean) * math.cos(turn) + nearer * x, math.cos(lean) * math.sin(turn) + nearer * y)
    ends = {"long": (long * ahead[0], long * ahead[1]), "thick": (-thick * math.sin(turn), thick * math.cos(turn))}
    handles = {name: (u + camera.fx / z * dx, v + camera.fy / z * dy) for name, (dx, dy) in ends.items()}
    return {name: (zoom * a, zoom * b) for name, (a, b) in {**handles, "middle": (u, v)}.items()}


def touch_gaussian(stroke: Stroke, values: Mapping[str, Any], camera: Camera, zoom: int) -> dict[str, float]:
    """What a drag changes: the place, or the length of an axis and for the long one its direction too."""
    (du, dv), z = stroke.moved, values["z_m"]
    if stroke.shift:
        return {"z_m": z * math.exp(-dv / 150)}
    handles = gaussian_handles(values, camera, zoom)
    held = nearest_handle(handles, stroke.start)
    if held is None:
        return {}
    if held == "middle":
        return {"x_m": values["x_m"] + du * z / camera.fx / zoom, "y_m": values["y_m"] + dv * z / camera.fy / zoom}
    (u, v), (mid_u, mid_v) = handles[held], handles["middle"]
    dx, dy = (u + du - mid_u) * z / camera.fx / zoom, (v + dv - mid_v) * z / camera.fy / zoom
    turn, lean = math.radians(values["turn_deg"]), math.radians(values["lean_deg"])
    if held == "thick":
        return {"thick_m": abs(dy * math.cos(turn) - dx * math.sin(turn))}
    return _long_axis((dx, dy), lean, (math.sin(lean) * values["x_m"] / z, math.sin(lean) * values["y_m"] / z))


def _long_axis(end: Point, lean: float, nearer: Point) -> dict[str, float]:
    """Length l and turn t of the axis that ends there: end = l (cos(lean) (cos t, sin t) + nearer)."""
    a = nearer[0] ** 2 + nearer[1] ** 2 - math.cos(lean) ** 2
    b, c = -2 * (end[0] * nearer[0] + end[1] * nearer[1]), end[0] ** 2 + end[1] ** 2
    inside = b * b - 4 * a * c
    if a >= -1e-6 or inside < 0:  # the axis points along the viewing ray: its end does not say how long it is
        return {}
    long = (-b - math.sqrt(inside)) / (2 * a)
    turn = math.atan2(end[1] - long * nearer[1], end[0] - long * nearer[0])
    return {"long_m": long, "turn_deg": math.degrees(turn)}


def sh_ball_panel() -> Panel:
    """One coefficient of one basis function of the colour, painted on a ball (``sh_ball``)."""

    def draw(k: int, red: float | int, green: float | int, blue: float | int) -> Drawn:
        sh = torch.zeros(16, 3)
        sh[k] = torch.tensor([red, green, blue], dtype=torch.float32)
        return _with_axes(sh_ball(sh, _BALL_PX)), f"all coefficients are 0 but sh<sub>{k}</sub>"

    controls = {
        "k": Slider(value=3, low=0, high=15, step=1, label="function k"),
        **{
            name: Slider(value=start, low=-1.5, high=1.5, step=0.05, label=f"sh_k, {name}")
            for name, start in (("red", 0.6), ("green", 0.0), ("blue", -0.6))
        },
    }
    return Panel(draw, controls, name="sh-ball", kind="png", text="A Gaussian's colour from all sides")


def _with_axes(ball: Picture) -> Picture:
    """Small x and y arrows in the corner; z points into the picture."""
    import cv2

    picture, ink = ball.copy(), CARD_INK
    o = (10, 10)
    for end, name, at in (((38, 10), "x", (42, 15)), ((10, 38), "y", (6, 54))):
        cv2.arrowedLine(picture, o, end, ink, 1, cv2.LINE_AA, tipLength=0.25)
        cv2.putText(picture, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)
    return np.ascontiguousarray(picture)
