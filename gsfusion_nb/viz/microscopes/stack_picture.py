"""Drawings of a pixel's stack of Gaussians: weights and transmittance as a graph, and the enlarged neighbourhood."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...drawing.pictures import CARD, CARD_INK, AnyImage, Picture, to_uint8
from .pixel_stack import PixelStack, Splats

INK, FAINT, LIGHT = (28, 36, 48), (84, 92, 104), (229, 98, 115)
"""Colour of lines in pictures, of grid lines on the card, and of the curve of the transmittance."""
CROSS = (255, 210, 0)
"""Colour of the mark at the chosen pixel."""


def stack_picture(stack: PixelStack, *, width: int = 420, height: int = 240, scale: int = 2) -> Picture:
    """One bar per Gaussian, nearest at the left, and below them the colour as it builds up.

    The pale bar is alpha, the full one the weight, in the Gaussian's colour; the red steps are the transmittance. The
    strip at the bottom is the sum of w c so far: its right end is the colour of the pixel.

    Args:
        stack: From ``pixel_stack``.
        width, height: Size on screen, pixels.
        scale: Picture pixels per screen pixel.
    """
    import cv2

    s = scale
    image, (left, right, top, bottom) = empty_graph(width, height, s, left_px=40, below_px=66)
    strip = slice((height - 40) * s, (height - 24) * s)
    write(image, "red: light left T   pale: alpha   full: weight w = alpha T", left, 14 * s, s, ink=CARD_INK)
    write(image, "sum", 10 * s, strip.stop - 4 * s, s, ink=CARD_INK)
    caption = "nearest Gaussian first, to the farthest; below: the colour summed up so far"
    write(image, caption, left, (height - 8) * s, s, ink=CARD_INK)
    edges = np.linspace(left, right, max(len(stack), 1) + 1).round().astype(int)
    _bars(image, stack, edges, (top, bottom), s)
    colours = to_uint8(stack.contribution.cumsum(0).clamp(0, 1)[None])[0]
    for k, colour in enumerate(colours):
        image[strip, edges[k] : edges[k + 1]] = colour
    T = np.array([*stack.transmittance.tolist(), stack.light_left])
    y = (bottom + T * (top - bottom)).round().astype(int)
    steps = list(zip(edges[: len(T)], y, strict=True))
    corners = [steps[0], *(c for a, b in pairwise(steps) for c in ((b[0], a[1]), b)), (right, y[-1])]
    cv2.polylines(image, [np.array(corners, np.int32)], False, LIGHT, s, cv2.LINE_AA)
    return image


def empty_graph(
    width: int, height: int, scale: int, *, left_px: int, below_px: int
) -> tuple[Picture, tuple[int, int, int, int]]:
    """A card with lines at 0, 0.5 and 1, and where they are: left, right, top (1) and bottom (0), picture pixels.

    Args:
        width, height: Size on screen, pixels.
        scale: Picture pixels per screen pixel.
        left_px, below_px: Room at the left of the lines and below them, screen pixels.
    """
    import cv2

    s = scale
    image = np.full((height * s, width * s, 3), CARD, np.uint8)
    left, right, top, bottom = left_px * s, (width - 12) * s, 24 * s, (height - below_px) * s
    for value in (0.0, 0.5, 1.0):
        y = round(bottom + value * (top - bottom))
        cv2.line(image, (left, y), (right, y), FAINT, s)
        write(image, f"{value:g}", 10 * s, y + 4 * s, s, ink=CARD_INK)
    return image, (left, right, top, bottom)


def _bars(image: Picture, stack: PixelStack, edges: np.ndarray, span: tuple[int, int], gap: int) -> None:
    """Alpha and weight of each Gaussian as bars between ``edges``, in place."""
    import cv2

    top, bottom = span
    full = to_uint8(stack.rgb[None])[0].astype(float)
    for k, colour in enumerate(full):
        x0, x1 = int(edges[k]), max(int(edges[k + 1]) - gap, int(edges[k]) + 1)
        for value, fill in ((stack.alpha[k], 0.35 * colour + 0.65 * np.array(CARD)), (stack.weight[k], colour)):
            y = round(bottom + float(value) * (top - bottom))
            cv2.rectangle(image, (x0, y), (x1, bottom), tuple(int(c) for c in fill), -1)
            cv2.rectangle(image, (x0, y), (x1, bottom), (150, 156, 166), 1)


def lens_picture(
    image: AnyImage,
    splats: Splats,
    pixel: tuple[int, int],
    rows: Int[Tensor, " K"],
    *,
    radius_px: int = 12,
    size: int = 300,
) -> Picture:
    """The neighbourhood of a pixel, enlarged without smoothing, with the ellipses of some Gaussians.

    An ellipse is where its Gaussian has fallen to exp(-1/2): one standard deviation.

    Args:
        image: The rendered picture. [H, W, 3]
        splats: What it was rendered from.
        pixel: In the middle, framed. (column, row)
        rows: Gaussians to outline, the most important first, which gets a thicker line.
        radius_px: Pixels of the image to each side.
        size: Edge of the result, pixels.
    """
    import cv2

    picture = to_uint8(image)
    H, W = picture.shape[:2]
    u0, v0 = pixel[0] - radius_px, pixel[1] - radius_px
    n = 2 * radius_px + 1
    crop = np.full((n, n, 3), 236, np.uint8)
    a, b, c, d = max(v0, 0), min(v0 + n, H), max(u0, 0), min(u0 + n, W)
    crop[a - v0 : b - v0, c - u0 : d - u0] = picture[a:b, c:d]
    view = np.asarray(cv2.resize(crop, (size, size), interpolation=cv2.INTER_NEAREST), np.uint8)
    zoom = size / n
    for i, outline in reversed(list(enumerate(outlines(splats, rows)))):
        points = ((outline - np.array([u0, v0])) * zoom * 16).round().astype(np.int32)
        for ink, wide in (((255, 255, 255), 3), (INK, 1)) if i else (((255, 255, 255), 5), (INK, 2)):
            cv2.polylines(view, [points], True, ink, wide, cv2.LINE_AA, shift=4)
    x = y = round(radius_px * zoom)
    cv2.rectangle(view, (x, y), (x + round(zoom), y + round(zoom)), CROSS, 2)
    return view


def outlines(splats: Splats, rows: Int[Tensor, " K"], points: int = 48) -> Float[np.ndarray, "K points 2"]:
    """The one-standard-deviation ellipses of some rows as polygons, pixels."""
    return ellipse_outlines(splats.projection.uv[rows], splats.projection.conic[rows], points)


def ellipse_outlines(
    uv: Float[Tensor, "K 2"], conic: Float[Tensor, "K 3"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """Ellipses of one standard deviation as polygons, pixels: u + L (cos t, sin t) with L L^T = cov = conic^-1."""
    A, B, C = conic.double().unbind(-1)
    det = A * C - B * B
    cov_uu, cov_uv, cov_vv = C / det, -B / det, A / det
    l11 = cov_uu.sqrt()
    l21 = cov_uv / l11
    l22 = (cov_vv - l21 * l21).clamp_min(0).sqrt()
    t = torch.linspace(0, 2 * torch.pi, points + 1, dtype=torch.float64)[:-1]
    cos, sin = t.cos(), t.sin()
    ring = torch.stack([l11[:, None] * cos, l21[:, None] * cos + l22[:, None] * sin], -1)
    return (uv.double()[:, None] + ring).numpy()


def with_cross(image: AnyImage, u: int, v: int, height: int) -> Picture:
    """The picture resized to ``height`` pixels, with a small cross around pixel (u, v), open in the middle."""
    import cv2

    picture, zoom = resize_to_height(image, height), height / image.shape[0]
    x, y = round((u + 0.5) * zoom), round((v + 0.5) * zoom)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner, outer = ((x + r * dx, y + r * dy) for r in (5, 13))
        cv2.line(picture, inner, outer, (0, 0, 0), 4)
        cv2.line(picture, inner, outer, CROSS, 2)
    return picture


def resize_to_height(image: AnyImage, height: int) -> Picture:
    """The picture at another height, pixels; enlarged pixels stay sharp squares."""
    import cv2

    picture = to_uint8(image)
    zoom = height / picture.shape[0]
    how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (round(picture.shape[1] * zoom), height), interpolation=how), np.uint8)


def write(
    image: Picture, words: str, x: int, y: int, scale: int, size: float = 0.36, ink: tuple[int, ...] = INK
) -> None:
    """Write small text into a drawing, in place; text too long for it is written smaller."""
    import cv2

    font = cv2.FONT_HERSHEY_SIMPLEX
    (wide, _), _ = cv2.getTextSize(words, font, size * scale, scale)
    size *= min(1.0, (image.shape[1] - x - 4) / max(wide, 1))
    cv2.putText(image, words, (x, y), font, size * scale, ink, max(1, scale // 2), cv2.LINE_AA)


def ellipse_picture(splats: Splats, height: int) -> Picture:
    """The ellipses of all Gaussians of a map in their own colours on dark grey, farthest first.

    Args:
        splats: The Gaussians on the screen.
        height: Of the picture, pixels.
    """
    import cv2

    p, camera = splats.projection, splats.camera
    zoom = height / camera.height
    view = np.full((height, round(camera.width * zoom), 3), 32, np.uint8)
    rows = p.visible.nonzero().squeeze(1)
    rows = rows[p.depth_m[rows].argsort(descending=True)]
    rings = (outlines(splats, rows, 20) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
    inks = to_uint8(splats.rgb[rows][None])[0].tolist()
    for ring, ink in zip(rings, inks, strict=True):
        cv2.polylines(view, [ring], True, ink, 1, cv2.LINE_AA, shift=4)
    return view
