"""The Gaussian map as a picture, in its own colours or coloured by a number per Gaussian."""

import dataclasses
import functools
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...checks import check_name, check_shape
from ...drawing.pictures import Picture, colour_depth, colour_stops, depth_range_m, to_uint8
from ...evaluation import expected_depth_m
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import render
from ...types import Camera, GaussianParams, RenderOutput

Show = Literal["colour", "depth", "opacity", "first-seen frame", "quadtree level"]
SHOWS: tuple[str, ...] = get_args(Show)
"""What ``draw_gaussians`` can show."""

_BAR_PX = 14


def draw_gaussians(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    show: Show = "colour",
    *,
    labels: Int[Tensor, " N"] | None = None,
    cut_m: float | int = 0.0,
) -> Picture:
    """What a camera sees of the map, as an 8-bit picture with its colour scale in the lower left corner.

    Args:
        params: The map; any number of rows.
        camera: Intrinsics and size of the picture.
        T_WC: Camera-to-world pose.
        show: "colour"; "depth" (expected depth, striped where there is none); "opacity" (accumulated, black to white);
            "first-seen frame" and "quadtree level" paint every Gaussian by its row of ``labels``.
        labels: ``birth_frame`` or ``tag`` of each Gaussian, for the last two. [N]
        cut_m: Leave out every Gaussian whose centre is nearer than this, z-depth in metres: opens a closed room.

    Raises:
        KeyError: no such ``show``. ValueError: ``labels`` are missing or not one per Gaussian.
    """
    check_name("show", show, SHOWS)
    by_label = show in ("first-seen frame", "quadtree level")
    low = high = 0
    if by_label:
        if labels is None:
            raise ValueError(f"show={show!r} needs labels: one whole number per Gaussian (birth_frame or tag)")
        check_shape("labels", labels, (len(params),))
        low, high = (int(labels.min()), int(labels.max())) if len(labels) else (0, 0)
        params = _painted(params, labels, low, high)
    if cut_m > 0:
        z = (params.xyz_W - T_WC[:3, 3].to(params.xyz_W)) @ T_WC[:3, 2].to(params.xyz_W)
        params = params[z > cut_m]
    view = render(params, camera, T_WC)
    if by_label:
        word = "frame" if show == "first-seen frame" else "level"
        return _with_scale(to_uint8(view.rgb), _table("viridis"), f"{word} {low}", str(high))
    return draw_view(view, show)


def draw_view(view: RenderOutput, show: Show = "colour") -> Picture:
    """A rendered view as an 8-bit picture of its colour, depth or opacity, as ``draw_gaussians`` shows them."""
    check_name("show", show, SHOWS[:3])
    if show == "colour":
        return to_uint8(view.rgb)
    if show == "opacity":
        grey = to_uint8(view.alpha[..., None].expand(-1, -1, 3))
        return _with_scale(grey, np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, 1), "0", "1")
    depth = expected_depth_m(view)
    near, far = depth_range_m(depth)
    return _with_scale(colour_depth(depth, near, far), _table("turbo"), f"{near:.1f} m", f"{far:.1f} m")


def _painted(params: GaussianParams, labels: Tensor, low: int, high: int) -> GaussianParams:
    """The same Gaussians in the colour of their label, the same from every side."""
    level = (labels - low) * 255 // max(high - low, 1)
    colours = torch.from_numpy(_table("viridis")).to(params.sh) / 255
    sh = rgb_to_sh_dc(colours[level.long()])
    return dataclasses.replace(params, sh=sh[:, None])


def _with_scale(picture: Picture, colours: np.ndarray, low: str, high: str) -> Picture:
    """A colour bar with the values at its ends, over a dark strip in the lower left corner."""
    import cv2

    height, width = picture.shape[:2]
    font, size, bar = cv2.FONT_HERSHEY_SIMPLEX, 0.4, min(110, width // 3)
    ends = [cv2.getTextSize(text, font, size, 1)[0][0] for text in (low, high)]
    total = bar + sum(ends) + 20
    if total > width or height < 2 * _BAR_PX:
        return picture
    top = height - _BAR_PX - 4
    picture[top:, :total] = 24
    x = ends[0] + 10
    ramp = colours[np.linspace(0, 255, bar).astype(int)]
    picture[top + 4 : height - 4, x : x + bar] = ramp[None]
    for text, at in ((low, 4), (high, x + bar + 6)):
        cv2.putText(picture, text, (at, height - 5), font, size, (235, 235, 235), 1, cv2.LINE_AA)
    return picture


@functools.cache
def _table(name: str) -> np.ndarray:
    """The 256 colours of a colour map, bytes. [256, 3]"""
    return np.array([[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in colour_stops(name, 256)], np.uint8)
