"""A plane through a TSDF volume as a picture: signed distance, weight or colour, voxel by voxel."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import CARD, CARD_INK, Picture, colour_stops, to_uint8
from ...tsdf import TsdfVolume
from ...types import Camera

QUANTITIES = ("distance", "weight", "colour")
"""What a slice can show."""
X_M, Y_M, PX_PER_M = (-2.6, 2.6), (-2.1, 2.1), 60
"""Usual extent of a slice, metres, and its scale, pixels per metre."""

_BEHIND, _ZERO, _FREE = (178, 34, 52), (255, 255, 255), (44, 98, 168)
_UNSEEN = (58, 78)
"""Grey levels of the stripes where no voxel was observed."""
LEGEND_PX = 30
"""Height of the colour bar below a slice."""
_CAMERA = (255, 140, 0)


def slice_picture(
    volume: TsdfVolume,
    *,
    height_m: float | int = 1.0,
    x_m: tuple[float, float] = X_M,
    y_m: tuple[float, float] = Y_M,
    px_per_m: float | int = PX_PER_M,
    quantity: str = "distance",
    max_weight: float | int = 20,
) -> Picture:
    """The horizontal plane z = ``height_m`` from above, x to the right and y up.

    "distance": D from red (-1, behind a surface) over white (0, on it) to blue (+1, free); "weight": the observation
    count from dark (1) to bright (``max_weight`` and more); "colour": the mean colour. Voxels never observed, and where
    there are none, are striped grey. Each pixel shows the voxel that contains it, without interpolation.

    Args:
        volume: The map.
        height_m: Height of the plane, metres.
        x_m, y_m: Extent, metres.
        px_per_m: Scale, pixels per metre.
        quantity: What is shown.
        max_weight: Weight at the brightest colour.

    Raises:
        ValueError: unknown quantity.
    """
    if quantity not in QUANTITIES:
        raise ValueError(f"quantity must be one of {', '.join(QUANTITIES)}, got {quantity!r}")
    width, height = (max(1, round((b - a) * px_per_m)) for a, b in (x_m, y_m))
    x = x_m[0] + (torch.arange(width) + 0.5) / px_per_m
    y = y_m[1] - (torch.arange(height) + 0.5) / px_per_m
    xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).view(-1, 2)
    points = torch.cat([xy, torch.full_like(xy[:, :1], float(height_m))], dim=1)
    sample = volume.sample_nearest(points.to(volume.device))
    D, W = (a.cpu().numpy().reshape(height, width) for a in (sample.D, sample.W))
    if quantity == "distance":
        image = distance_colours(D)
    elif quantity == "weight":
        image = _weight_colours(W, max_weight)
    else:
        image = to_uint8(sample.rgb.view(height, width, 3))
    stripes = (np.add.outer(np.arange(height), np.arange(width)) // 4) % 2
    return np.where((W > 0)[..., None], image, np.where(stripes, *_UNSEEN)[..., None]).astype(np.uint8)


def distance_colours(D: Float[np.ndarray, "H W"] | Float[Tensor, "H W"]) -> Picture:
    """Truncated signed distance as colour: red -1, white 0, blue +1."""
    d = np.clip(np.asarray(D, dtype=np.float32), -1, 1)[..., None]
    behind, zero, free = (np.array(c, np.float32) for c in (_BEHIND, _ZERO, _FREE))
    colour = np.where(d < 0, zero + (zero - behind) * d, zero + (free - zero) * d)
    return (colour + 0.5).astype(np.uint8)


def draw_camera(
    picture: Picture,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    x_m: tuple[float, float] = X_M,
    y_m: tuple[float, float] = Y_M,
    px_per_m: float | int = PX_PER_M,
    reach_m: float | int = 1.2,
) -> Picture:
    """A copy of a slice with the camera on it: a dot, and the left and the right edge of what it sees."""
    import cv2

    T = T_WC.detach().cpu().double().numpy()
    edges = [np.array([(u - camera.cx) / camera.fx, 0.0, 1.0]) * reach_m for u in (0.0, float(camera.width))]
    corners = [T[:3, 3], *(T[:3, :3] @ e + T[:3, 3] for e in edges)]
    at = [(round((c[0] - x_m[0]) * px_per_m * 16), round((y_m[1] - c[1]) * px_per_m * 16)) for c in corners]
    image = picture.copy()
    for ink, thickness in (((30, 30, 30), 4), (_CAMERA, 2)):
        cv2.line(image, at[0], at[1], ink, thickness, cv2.LINE_AA, 4)
        cv2.line(image, at[0], at[2], ink, thickness, cv2.LINE_AA, 4)
        cv2.circle(image, at[0], (3 + thickness) * 16, ink, -1, cv2.LINE_AA, 4)
    return image


def slice_pixel(x_m: float | int, y_m: float | int) -> tuple[float, float]:
    """(u, v) of a point of the world in a slice of the usual extent and scale, pixels."""
    return (x_m - X_M[0]) * PX_PER_M, (Y_M[1] - y_m) * PX_PER_M


def slice_place(u: float | int, v: float | int) -> tuple[float, float]:
    """The world's (x, y), metres, at a pixel of such a slice."""
    return X_M[0] + u / PX_PER_M, Y_M[1] - v / PX_PER_M


def slice_legend(quantity: str, width: int, *, max_weight: float | int = 20) -> Picture:
    """The colour bar of a slice, ``width`` pixels wide."""
    image = np.full((LEGEND_PX, width, 3), CARD, np.uint8)
    left, right = 74, width - 74
    ramp = np.linspace(-1, 1, max(right - left, 2), dtype=np.float32)[None].repeat(10, 0)
    words = ("behind -1", "free +1")
    bar = distance_colours(ramp)
    if quantity == "weight":
        bar, words = _weight_colours((ramp + 1) / 2 * max_weight, max_weight), ("W = 0", f"{max_weight:g} or more")
    elif quantity == "colour":
        words = ("mean colour", "")
    if quantity != "colour":
        image[8:18, left : left + bar.shape[1]] = bar
        image[7:19, (left + right) // 2] = 120 if quantity == "distance" else image[7:19, (left + right) // 2]
    _write(image, words, (4, right + 6))
    return image


def _write(image: Picture, words: Sequence[str], x: tuple[int, int]) -> None:
    import cv2

    for text, at in zip(words, x, strict=True):
        cv2.putText(image, text, (at, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.36, CARD_INK, 1, cv2.LINE_AA)


def _weight_colours(W: np.ndarray, max_weight: float | int) -> Picture:
    stops = colour_stops("viridis", 256)
    table = np.array([[int(s[i : i + 2], 16) for i in (1, 3, 5)] for s in stops], np.uint8)
    return table[(np.clip(W / max_weight, 0, 1) * 255 + 0.5).astype(int)]
