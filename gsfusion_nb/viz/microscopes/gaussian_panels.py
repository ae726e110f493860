"""The panels of the chapter on splatting: one Gaussian with sliders, and its view-dependent colour."""

import numpy as np
import torch

from ...drawing.pictures import Picture
from ...types import Camera
from ..panels.panel import Drawn, Panel, Slider
from .one_gaussian import gaussian_row, orientation_from_angles, projection_caption, projection_picture, sh_ball

_BALL_PX = 280


def one_gaussian_panel(camera: Camera, *, zoom: int = 6) -> Panel:
    """Move, turn and stretch one Gaussian in front of a camera of few pixels (``projection_picture``)."""

    def draw(
        x_m: float | int, z_m: float | int, long_m: float | int, thick_m: float | int, turn_deg: int, lean_deg: int
    ) -> Drawn:
        scale = torch.tensor([float(long_m), float(thick_m), 0.02])
        params = gaussian_row(
            torch.tensor([float(x_m), 0.0, float(z_m)]), scale, orientation_from_angles(turn_deg, lean_deg)
        )
        picture, splats = projection_picture(params, camera, zoom=zoom)
        return picture, projection_caption(splats)

    controls = {
        "x_m": Slider(value=0.0, low=-1.5, high=1.5, step=0.05, label="x, m"),
        "z_m": Slider(value=1.5, low=0.3, high=6.0, step=0.1, label="z, m", readout=".1f"),
        "long_m": Slider(value=0.3, low=0.01, high=0.6, step=0.01, label="long axis, m"),
        "thick_m": Slider(value=0.1, low=0.002, high=0.3, step=0.002, label="short axis, m", readout=".3f"),
        "turn_deg": Slider(value=30, low=-90, high=90, step=1, label="turn, °", tip="about the viewing axis"),
        "lean_deg": Slider(value=0, low=-90, high=90, step=1, label="lean, °", tip="about the vertical axis"),
    }
    return Panel(draw, controls, name="one-gaussian", text="One Gaussian and its image")


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

    picture, ink = ball.copy(), (28, 36, 48)
    o = (10, 10)
    for end, name, at in (((38, 10), "x", (42, 15)), ((10, 38), "y", (6, 54))):
        cv2.arrowedLine(picture, o, end, ink, 1, cv2.LINE_AA, tipLength=0.25)
        cv2.putText(picture, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)
    return np.ascontiguousarray(picture)
