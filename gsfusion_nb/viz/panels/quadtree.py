"""Panel of the quadtree of a picture: its cells, their mean colours, and a Gaussian for each."""

from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from ...drawing.page import html_table
from ...drawing.pictures import AnyImage, Picture, paint_cells, to_uint8
from ...errors import ArgumentError
from ...seeding import Cells, quadtree
from .panel import Choice, Drawn, Panel, Slider

QUADTREE_SHOWS = ("cells", "mean colours", "Gaussians")
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

    "cells": borders over the image, coarse purple to fine yellow; "mean colours": every cell filled
    with its mean; "Gaussians": a disc of one standard deviation (half the cell's diagonal, GSFusion
    III-B.2) in the colour of the pixel in the middle, smaller discs over larger ones.

    Args:
        rgb: Colour, 0..1 or bytes. [H, W, 3]
        threshold, min_cell_px, contrast: As for ``quadtree``.
        show: What is drawn.
        scale: Enlargement.

    Raises:
        ValueError: settings that ``quadtree`` refuses, or an unknown ``show``.
    """
    if show not in QUADTREE_SHOWS:
        raise ArgumentError(f"show must be one of {', '.join(QUADTREE_SHOWS)}, got {show!r}")
    photo = to_uint8(rgb)
    cells = quadtree(
        torch.from_numpy(photo),
        threshold=float(threshold),
        min_cell_px=min_cell_px,
        contrast=contrast,
    )
    if show == "cells":
        return paint_cells(photo, cells, scale=scale), cells
    picture = (
        cell_means(torch.from_numpy(photo), cells).numpy()
        if show == "mean colours"
        else _discs(photo, cells)
    )
    return picture.repeat(scale, 0).repeat(scale, 1), cells


def cell_means(rgb_u8: UInt8[Tensor, "H W 3"], cells: Cells) -> UInt8[Tensor, "H W 3"]:
    """The image with every cell filled by its mean colour."""
    image = rgb_u8.numpy().copy()
    for x, y, w, h in zip(
        *(a.tolist() for a in (cells.x0, cells.y0, cells.width, cells.height)),
        strict=True,
    ):
        cell = image[y : y + h, x : x + w]
        cell[:] = np.rint(cell.mean((0, 1)))
    return torch.from_numpy(image)


def _discs(photo: Picture, cells: Cells) -> Picture:
    picture = np.zeros_like(photo)
    centres = cells.centre_uv.tolist()
    radii = cells.half_diagonal_px.tolist()
    for k in cells.half_diagonal_px.argsort(descending=True).tolist():  # the largest first
        u, v = centres[k]
        radius = radii[k]
        ink = photo[int(v), int(u)].tolist()  # OpenCV's pixel centres are whole numbers
        cv2.circle(
            picture,
            (round(16 * (u - 0.5)), round(16 * (v - 0.5))),
            round(16 * radius),
            ink,
            -1,
            cv2.LINE_8,
            4,
        )
    return picture


def quadtree_panel(
    rgb: AnyImage,
    *,
    threshold: float | int = 0.1,
    min_cell_px: int = 1,
    scale: int = 1,
) -> Panel:
    """Sliders for threshold and smallest cell over an image, with the number of leaves at each
    level.

    Args:
        rgb: The image. [H, W, 3]
        threshold, min_cell_px: Where the sliders start.
        scale: Enlargement of the picture.
    """
    photo = to_uint8(rgb)

    def draw(*, threshold: float, min_cell_px: int, contrast: Any, show: str) -> Drawn:
        settings = {"threshold": threshold, "min_cell_px": min_cell_px, "contrast": contrast}
        picture, cells = quadtree_picture(photo, **settings, show=show, scale=scale)
        rows = [
            (str(level), f"{int(n):,}")
            for level, n in enumerate(torch.bincount(cells.level.long()))
            if n
        ]
        each = f"one for every {photo.shape[0] * photo.shape[1] / len(cells):.0f} pixels"
        count = f'<b class="gsnb-quadtree-count">{len(cells):,}</b> cells, {each}'
        return picture, count + html_table(rows, heads=("level", "cells"))

    controls = {
        "threshold": Slider(
            value=threshold,
            low=0.001,
            high=10,
            step=0.02,
            label="threshold",
            log=True,
            readout=".3g",
            tip="a cell is split if its contrast is above this",
        ),
        "min_cell_px": Slider(
            value=min_cell_px,
            low=1,
            high=32,
            step=1,
            label="min half size, px",
            tip="a cell is split only if half its size is above this",
        ),
        "contrast": Choice(value="released", options=CONTRASTS, label="contrast"),
        "show": Choice(value="cells", options=QUADTREE_SHOWS, label="show"),
    }
    return Panel(draw, controls, name="quadtree", kind="png", text="quadtree panel")
