"""Small graphs drawn with OpenCV in a millisecond, for panels that are redrawn many times a second."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from .curves import PALETTE
from .pictures import BETWEEN, Picture

_FAINT = (223, 228, 234)


def small_curves(
    series: Mapping[str, Sequence[float | int]], *, n_x: int, width: int = 320, height: int = 110, scale: int = 2
) -> Picture:
    """One small graph per series, in a row: its title and newest value above, the range of its values at the left.

    The ground is white, for ``encode_drawing`` or ``on_card``.

    Args:
        series: Title -> values so far, one per step; NaN leaves a gap.
        n_x: Number of steps of the whole run, which fill the width, so that the curve also shows progress.
        width, height: Size of one graph on screen, pixels.
        scale: Picture pixels per screen pixel; 2 looks sharp on fine screens.
    """
    graphs = []
    for i, (title, values) in enumerate(series.items()):
        colour = PALETTE[i % len(PALETTE)]
        rgb = tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5))
        graphs.append(_graph(title, values, n_x, (width * scale, height * scale), scale, rgb))
    return np.concatenate(graphs, axis=1)


def _graph(
    title: str, values: Sequence[float | int], n_x: int, size: tuple[int, int], s: int, rgb: tuple[int, ...]
) -> Picture:
    import cv2

    width, height = size
    image = np.full((height, width, 3), 255, np.uint8)
    left, right, top, bottom = 52 * s, width - 10 * s, 26 * s, height - 10 * s
    known = [v for v in values if math.isfinite(v)]
    low, high = _range(known)
    for y in (top, bottom):
        cv2.line(image, (left, y), (right, y), _FAINT, s)

    def text(words: str, x: int, y: int, size: float, ink: tuple[int, ...]) -> None:
        cv2.putText(image, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size * s, ink, s, cv2.LINE_AA)

    text(f"{title}  {number(known[-1])}" if known else title, left, top - 9 * s, 0.42, BETWEEN)
    if known:
        text(number(high), 4 * s, top + 5 * s, 0.38, BETWEEN)
        text(number(low), 4 * s, bottom + 3 * s, 0.38, BETWEEN)
    x = np.linspace(left, right, max(n_x, len(values), 2))[: len(values)]
    y = bottom - (np.array(values, float) - low) / (high - low) * (bottom - top)
    for run in _runs(np.isfinite(y)):
        points = np.stack([x[run], y[run]], 1).round().astype(np.int32)
        cv2.polylines(image, [points], False, rgb, 2 * s, cv2.LINE_AA)
        cv2.circle(image, [int(v) for v in points[-1]], 2 * s, rgb, -1, cv2.LINE_AA)
    return image


def number(value: float | int) -> str:
    """A value as short text for a small graph: 21.5, 3,294, 41.1k."""
    if abs(value) >= 10_000:
        return f"{value / 1000:,.1f}k"
    return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.1f}"


def _range(known: Sequence[float | int]) -> tuple[float, float]:
    """Limits of the vertical axis."""
    if not known:
        return 0.0, 1.0
    low, high = float(min(known)), float(max(known))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _runs(known: np.ndarray) -> list[slice]:
    """Stretches of consecutive known values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
