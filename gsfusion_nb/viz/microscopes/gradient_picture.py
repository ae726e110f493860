"""Drawings of gradients: arrows at the Gaussians of a pixel, and the gradient of one Gaussian from each pixel."""

import numpy as np
import torch

from ...drawing.pictures import AnyImage, Picture, to_uint8
from .pixel_gradient import GaussianGradient, PixelGradient
from .pixel_stack import Splats
from .stack_picture import CROSS, INK, outlines

MORE, LESS = (26, 127, 55), (198, 40, 40)
"""Green: gradient descent makes the Gaussian more opaque there; red: less."""
_SHOWN = 8


def pixel_gradient_picture(image: AnyImage, splats: Splats, gradient: PixelGradient, *, size: int = 300) -> Picture:
    """The Gaussians with the largest weights at a pixel, ellipses green (descent makes them more opaque) or red (less).

    An arrow points along -(dL/du, dL/dv), where descent moves the centre; the longest has a fixed length.
    """
    import cv2

    s = gradient.stack
    top = s.weight.argsort(descending=True)[:_SHOWN]
    centre = np.array([s.u + 0.5, s.v + 0.5])
    uv = splats.projection.uv[s.row[top]].double().numpy()
    far = np.abs(uv - centre).max(initial=0.0)
    radius = int(min(max(far * 1.15 + 2, 6), 40))
    view, zoom, origin = _lens(image, centre, radius, size)
    push = -gradient.v_uv[top].double().numpy()
    longest = max(float(np.linalg.norm(push, axis=1).max(initial=0.0)), 1e-30)
    for i, ring in reversed(list(enumerate(outlines(splats, s.row[top])))):
        v_alpha = float(gradient.v_alpha[top[i]])
        ink = INK if abs(v_alpha) < 1e-30 else (MORE if v_alpha < 0 else LESS)
        _ring(view, (ring - origin) * zoom, ink, 3 if i == 0 else 2)
    for i, at in enumerate(uv):
        start = (at - origin) * zoom
        _arrow(view, start, start + push[i] / longest * 0.16 * size, (255, 255, 255), 5)
        _arrow(view, start, start + push[i] / longest * 0.16 * size, INK, 2)
    x, y = ((np.array([s.u, s.v]) - origin) * zoom).round().astype(int)
    cv2.rectangle(view, (int(x), int(y)), (int(x + zoom), int(y + zoom)), CROSS, 2)
    return view


def gaussian_gradient_picture(
    image: AnyImage, splats: Splats, gradient: GaussianGradient, *, size: int = 300
) -> Picture:
    """The pixels under a Gaussian: green where descent makes it more opaque, red where less; arrows where it moves it.

    Small arrows are -(dL/du, dL/dv) of single pixels, averaged over a grid of at most 11 x 11; the thick one is their
    sum, not to the same scale.
    """
    import cv2

    centre = splats.projection.uv[gradient.row].double().numpy()
    reach = float((gradient.uv - splats.projection.uv[gradient.row]).abs().max()) if gradient.uv.numel() else 4.0
    view, zoom, origin = _lens(image, centre, int(min(max(reach + 2, 5), 60)), size)
    grey = view.mean(2, keepdims=True) * 0.5 + 110
    view = np.repeat(grey, 3, 2).clip(0, 255).astype(np.uint8)
    strongest = max(float(gradient.v_alpha.abs().max()) if gradient.v_alpha.numel() else 0.0, 1e-30)
    half = max(gradient.stride, 1) / 2
    for uv, value in zip(
        gradient.uv.view(-1, 2).tolist(), (gradient.v_alpha / strongest).flatten().tolist(), strict=True
    ):
        a, b = (
            ((np.array(uv) - half - origin) * zoom).round().astype(int),
            ((np.array(uv) + half - origin) * zoom).round().astype(int),
        )
        patch = view[max(a[1], 0) : max(b[1], 0), max(a[0], 0) : max(b[0], 0)]
        if patch.size:
            mix = min(abs(value), 1.0) ** 0.5 * 0.85
            patch[:] = (patch * (1 - mix) + np.array(MORE if value < 0 else LESS) * mix).astype(np.uint8)
    _ring(view, (outlines(splats, torch.tensor([gradient.row]))[0] - origin) * zoom, (255, 255, 255), 2)
    starts, pushes = _coarse(gradient)
    longest = max(float(np.linalg.norm(pushes, axis=1).max(initial=0.0)), 1e-30)
    for at, push in zip(starts, pushes, strict=True):
        start = (at - origin) * zoom
        _arrow(view, start, start + push / longest * 0.075 * size, INK, 1)
    total = -gradient.v_uv.sum((0, 1)).double().numpy()
    length = float(np.linalg.norm(total))
    if length > 1e-30:
        start = (centre - origin) * zoom
        for ink, wide in (((255, 255, 255), 8), ((40, 60, 200), 4)):
            _arrow(view, start, start + total / length * 0.2 * size, ink, wide)
    cv2.circle(view, tuple(int(c) for c in ((centre - origin) * zoom).round()), 4, (255, 255, 255), -1, cv2.LINE_AA)
    return view


def _coarse(gradient: GaussianGradient) -> tuple[np.ndarray, np.ndarray]:
    """Centres and mean -(dL/du, dL/dv) of at most 11 x 11 blocks of pixels."""
    h, w = gradient.weight.shape
    step = max(1, -(-max(h, w) // 11))
    at, push = gradient.uv.double().numpy(), -gradient.v_uv.double().numpy()
    blocks = [(y, x) for y in range(0, h, step) for x in range(0, w, step)]
    mean = [[a[y : y + step, x : x + step].mean((0, 1)) for y, x in blocks] for a in (at, push)]
    return np.array(mean[0]).reshape(-1, 2), np.array(mean[1]).reshape(-1, 2)


def _lens(image: AnyImage, centre: np.ndarray, radius: int, size: int) -> tuple[np.ndarray, float, np.ndarray]:
    """An enlarged square around a point; screen pixels per pixel; the pixel at its upper left corner."""
    import cv2

    picture = to_uint8(image)
    H, W = picture.shape[:2]
    u0, v0 = int(centre[0]) - radius, int(centre[1]) - radius
    n = 2 * radius + 1
    crop = np.full((n, n, 3), 236, np.uint8)
    a, b, c, d = max(v0, 0), min(v0 + n, H), max(u0, 0), min(u0 + n, W)
    if a < b and c < d:
        crop[a - v0 : b - v0, c - u0 : d - u0] = picture[a:b, c:d]
    view = cv2.resize(crop, (size, size), interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(view), size / n, np.array([u0, v0])


def _ring(view: np.ndarray, points: np.ndarray, ink: tuple[int, ...], wide: int) -> None:
    import cv2

    fixed = (points * 16).round().clip(-1e6, 1e6).astype(np.int32)
    cv2.polylines(view, [fixed], True, (255, 255, 255), wide + 2, cv2.LINE_AA, shift=4)
    cv2.polylines(view, [fixed], True, ink, wide, cv2.LINE_AA, shift=4)


def _arrow(view: np.ndarray, start: np.ndarray, end: np.ndarray, ink: tuple[int, ...], wide: int) -> None:
    import cv2

    a, b = (tuple(int(c) for c in p.round().clip(-10_000, 10_000)) for p in (start, end))
    if a != b:
        cv2.arrowedLine(view, a, b, ink, wide, cv2.LINE_AA, tipLength=0.35)
