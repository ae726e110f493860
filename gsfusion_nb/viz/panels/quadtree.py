"""A panel about the quadtree of a picture: threshold, smallest cell, the cells, and the number of Gaussians."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from ...drawing.page import html_table
from ...drawing.pictures import AnyImage, Picture, paint_cells, to_uint8
from ...seeding import Cells, quadtree
from .panel import Choice, Drawn, Panel, Slider

SHOWS = ("cells", "mean colours", "Gaussians")
"""What can be drawn."""
CONTRASTS = ("released", "std")


def quadtree_picture(
    rgb: AnyImage,
    *,
    threshold: float | int = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
    show: str = "cells",
    scale: int = 1,
) -> tuple[Picture, Cells]:
    """The leaves of an image's quadtree drawn, and the leaves themselves.

    "cells": borders over the image, coarse purple to fine yellow; "mean colours": every cell filled with its mean;
    "Gaussians": a disc of one standard deviation (half the cell's diagonal, GSFusion III-B.2) in the colour of the
    pixel in the middle, smaller discs over larger ones.

    Args:
        rgb: Colour, 0..1 or bytes. [H, W, 3]
        threshold, min_cell_px, contrast: As for ``quadtree``.
        show: What is drawn.
        scale: Enlargement.

    Raises:
        ValueError: settings that ``quadtree`` refuses, or an unknown ``show``.
    """
    if show not in SHOWS:
        raise ValueError(f"show must be one of {', '.join(SHOWS)}, got {show!r}")
    photo = to_uint8(rgb)
    cells = quadtree(torch.from_numpy(photo), threshold=float(threshold), min_cell_px=min_cell_px, contrast=contrast)
    if show == "cells":
        return paint_cells(photo, cells, scale=scale), cells
    picture = cell_means(torch.from_numpy(photo), cells).numpy() if show == "mean colours" else _discs(photo, cells)
    return picture.repeat(scale, 0).repeat(scale, 1), cells


def cell_means(rgb_u8: UInt8[Tensor, "H W 3"], cells: Cells) -> UInt8[Tensor, "H W 3"]:
    """The image with every cell filled by its mean colour."""
    x0, y0, w, h = (a.long() for a in (cells.x0, cells.y0, cells.width, cells.height))
    table = torch.nn.functional.pad(rgb_u8.long().cumsum(0).cumsum(1), (0, 0, 1, 0, 1, 0))
    sums = table[y0 + h, x0 + w] - table[y0, x0 + w] - table[y0 + h, x0] + table[y0, x0]
    mean = (sums.double() / (w * h)[:, None]).round().to(torch.uint8)
    return mean[_owner(cells, rgb_u8.shape[0], rgb_u8.shape[1])]


def _owner(cells: Cells, height: int, width: int) -> Tensor:
    """Row of the cell that each pixel belongs to."""
    n = len(cells)
    x0, y0 = cells.x0.long(), cells.y0.long()
    count = (cells.width * cells.height).long()
    row = torch.arange(n).repeat_interleave(count)
    nth = torch.arange(int(count.sum())) - (count.cumsum(0) - count)[row]
    across = cells.width.long()[row]
    owner = torch.zeros(height, width, dtype=torch.int64)
    owner[y0[row] + nth // across, x0[row] + nth % across] = row
    return owner


def _discs(photo: Picture, cells: Cells) -> Picture:
    centre, radius = cells.centre_uv.numpy(), cells.half_diagonal_px.numpy()
    corner = np.floor(centre).astype(int)
    colour = photo[tuple(corner.T[::-1])]
    kinds, kind = np.unique(np.column_stack([-radius, centre - corner]), axis=0, return_inverse=True)
    flat = np.zeros_like(photo).reshape(-1, 3)
    for k, (minus_radius, *within) in enumerate(kinds):  # the largest first
        chosen = np.flatnonzero(kind == k)
        pixels = corner[chosen, None] + _disc_pixels(-minus_radius, within)
        inside = ((pixels >= 0) & (pixels < photo.shape[1::-1])).all(-1)
        x, y = pixels[inside].T
        flat[y * photo.shape[1] + x] = np.broadcast_to(colour[chosen, None], (*pixels.shape[:2], 3))[inside]
    return flat.reshape(photo.shape)


def _disc_pixels(radius: float, within: Sequence[float]) -> Int[np.ndarray, "K 2"]:
    """Pixels (x, y) of a disc, relative to the pixel in which its centre lies ``within`` (0..1, from the corner)."""
    import cv2

    half = int(np.ceil(radius)) + 1
    stamp = np.zeros((2 * half + 1, 2 * half + 1), np.uint8)
    x, y = (round(16 * (half + float(c) - 0.5)) for c in within)  # OpenCV's pixel centres are whole numbers
    cv2.circle(stamp, (x, y), round(16 * float(radius)), 1, -1, cv2.LINE_8, 4)
    return np.argwhere(stamp)[:, ::-1] - half


def quadtree_panel(rgb: AnyImage, *, threshold: float | int = 0.1, min_cell_px: int = 1, scale: int = 1) -> Panel:
    """Sliders for threshold and smallest cell over an image, with the number of leaves at each level.

    Args:
        rgb: The image. [H, W, 3]
        threshold, min_cell_px: Where the sliders start.
        scale: Enlargement of the picture.
    """
    photo = to_uint8(rgb)

    def draw(*, threshold: float, min_cell_px: int, contrast: Any, show: str) -> Drawn:
        settings = {"threshold": threshold, "min_cell_px": min_cell_px, "contrast": contrast}
        picture, cells = quadtree_picture(photo, **settings, show=show, scale=scale)
        return picture, _counts(cells, photo.shape[0] * photo.shape[1])

    controls = {
        "threshold": Slider(
            value=threshold, low=0.001, high=10, step=0.02, label="threshold", log=True, readout=".3g",
            tip="a cell is split if its contrast is above this",
        ),
        "min_cell_px": Slider(
            value=min_cell_px, low=1, high=32, step=1, label="min half size, px",
            tip="a cell is split only if half its size is above this",
        ),
        "contrast": Choice(value="released", options=CONTRASTS, label="contrast"),
        "show": Choice(value="cells", options=SHOWS, label="show"),
    }  # fmt: skip
    return Panel(draw, controls, name="quadtree", kind="png", text="quadtree panel")


def _counts(cells: Cells, pixels: int) -> str:
    levels = torch.bincount(cells.level.long())
    rows = [(str(level), f"{int(n):,}") for level, n in enumerate(levels) if n]
    count = f'<b class="gsnb-quadtree-count">{len(cells):,}</b> cells, one for every {pixels / len(cells):.0f} pixels'
    return count + html_table(rows, heads=("level", "cells"))
