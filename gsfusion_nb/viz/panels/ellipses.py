"""Pictures of a map with the outlines of its Gaussians."""

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...drawing.curves import figure_picture, image_figure
from ...drawing.pictures import AnyImage, Picture, to_uint8
from .pixel_blend import Splats
from .pixel_stack import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


CROSS = "#ffd200"
"""Lines in pictures, and the mark at the chosen pixel."""


def lens_picture(
    image: AnyImage,
    splats: Splats,
    pixel: tuple[int, int],
    rows: Int[Tensor, " K"],
    *,
    radius_px: int = 12,
    size: int = 300,
) -> Picture:
    """The neighbourhood of a pixel, enlarged without smoothing, with the ellipses of some
    Gaussians.

    An ellipse is where its Gaussian has fallen to exp(-1/2): one standard deviation.

    Args:
        image: The rendered picture. [H, W, 3]
        splats: What it was rendered from.
        pixel: In the middle, framed. (column, row)
        rows: Gaussians to outline, the most important first, which gets a thicker line.
        radius_px: Pixels of the image to each side.
        size: Edge of the result, pixels.
    """
    figure, axes = lens_figure(image, pixel, radius_px, size)
    draw_ellipses(axes, splats, rows, INK)
    return figure_picture(figure)


def lens_figure(
    image: AnyImage, pixel: tuple[int, int], radius_px: int, size: int
) -> tuple["Figure", "Axes"]:
    """A square around a pixel, which is framed; ``image_figure`` with ``radius_px`` more pixels to
    each side."""
    from matplotlib.patches import Rectangle

    u, v = pixel
    r = radius_px
    figure, axes = image_figure(
        image,
        (size, size),
        (u - r, u + r + 1, v - r, v + r + 1),
    )
    axes.add_patch(
        Rectangle(
            pixel,
            1,
            1,
            fill=False,
            edgecolor=CROSS,
            linewidth=1.5,
            zorder=5,
        )
    )
    return figure, axes


def draw_ellipses(
    axes: "Axes",
    splats: Splats,
    rows: Int[Tensor, " K"],
    inks: Any,
) -> None:
    """Outlines of one standard deviation with a white seam, the first row's on top and thicker; one
    ink or one each."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patheffects import withStroke

    wide = [1.0] * (len(rows) - 1) + [2.0]
    axes.add_collection(
        PolyCollection(
            list(outlines(splats, rows)[::-1]),
            facecolors="none",
            edgecolors=inks if isinstance(inks, str) else inks[::-1],
            linewidths=wide,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )
    )


def outlines(
    splats: Splats, rows: Int[Tensor, " K"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """The one-standard-deviation ellipses of some rows as polygons, pixels."""
    return ellipse_outlines(splats.projection.uv[rows], splats.projection.conic[rows], points)


def ellipse_outlines(
    uv: Float[Tensor, "K 2"], conic: Float[Tensor, "K 3"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """Ellipses of one standard deviation as polygons, pixels: u + L (cos t, sin t) with L L^T = cov
    = conic^-1."""
    A, B, C = conic.double().unbind(-1)
    cov = torch.linalg.inv(torch.stack([A, B, B, C], -1).view(-1, 2, 2))
    t = torch.linspace(0, 2 * torch.pi, points + 1, dtype=torch.float64)[:-1]
    ring = torch.linalg.cholesky(cov) @ torch.stack([t.cos(), t.sin()])
    return (uv.double()[:, :, None] + ring).mT.numpy()


def with_cross(image: AnyImage, u: int, v: int, height: int) -> Picture:
    """The picture resized to ``height`` pixels, with a small cross around pixel (u, v)."""
    zoom = height / image.shape[0]
    return draw_cross(
        resize_to_height(image, height),
        ((u + 0.5) * zoom, (v + 0.5) * zoom),
    )


def draw_cross(picture: Picture, at: tuple[float, float]) -> Picture:
    """A copy of the picture with a small cross around a point (u, v), pixels, open in the
    middle."""
    image = picture.copy()
    x = round(at[0] - 0.5)
    y = round(at[1] - 0.5)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner, outer = ((x + r * dx, y + r * dy) for r in (4, 12))
        cv2.line(image, inner, outer, (0, 0, 0), 4)
        cv2.line(image, inner, outer, (255, 210, 0), 2)
    return image


def resize_to_height(image: AnyImage, height: int) -> Picture:
    """The picture at another height, pixels; enlarged pixels stay sharp squares."""
    picture = to_uint8(image)
    zoom = height / picture.shape[0]
    how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return np.asarray(
        cv2.resize(picture, (round(picture.shape[1] * zoom), height), interpolation=how),
        np.uint8,
    )


def ellipse_picture(splats: Splats, height: int) -> Picture:
    """The ellipses of all Gaussians of a map in their own colours on dark grey, farthest first.

    Args:
        splats: The Gaussians on the screen.
        height: Of the picture, pixels.
    """
    p = splats.projection
    camera = splats.camera
    zoom = height / camera.height
    view = np.full(
        (height, round(camera.width * zoom), 3),
        32,
        np.uint8,
    )
    rows = p.visible.nonzero().squeeze(1)
    rows = rows[p.depth_m[rows].argsort(descending=True)]
    rings = (outlines(splats, rows, 20) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
    inks = to_uint8(splats.rgb[rows][None])[0].tolist()
    for ring, ink in zip(rings, inks, strict=True):
        cv2.polylines(view, [ring], True, ink, 1, cv2.LINE_AA, shift=4)
    return view
