"""Is colour shifted against depth, or was it taken at another time?

In one stretch of even motion both look the same: the colour edges lie beside the depth edges. But a shift stays where
it is, and a time offset moves the edges with the speed of the image. So the shift is measured in several short windows
and fitted by a line over the image's speed: its constant part is a shift, its slope a time.
"""

from collections import abc
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .alignment import colour_contrast, depth_edges, peak_of, shift_surface
from .sample import FrameFacts, Sample

WINDOW = 5
"""Frames of a window: enough edges, and hardly a change of speed."""
_WINDOWS = 18
_CLEAR = 3.5
"""Height of a window's peak, in standard deviations, from which its shift is used."""
_LAG_PRIOR = 0.5
"""Time offsets of a recording whose frames were paired by time are at most about half a frame."""
_EDGES = 40


@dataclass(frozen=True, kw_only=True)
class ColourMotion:
    """The shift of colour against depth over the image's speed; pixels are those of the full image."""

    shift_px: tuple[float, float]
    """Constant part, right and down."""
    shift_error_px: float
    """Its standard error, the larger of both."""
    lag_frames: float
    """Colour was taken this much later than depth."""
    lag_error_frames: float
    speed_px: float
    """Fastest motion of the image in a window used, pixels per frame."""
    windows: int
    separable: bool
    """Whether slow motion, or motion in both directions, is among the windows: else shift and time look alike."""


def colour_motion(sample: Sample, speed: abc.Mapping[int, np.ndarray]) -> ColourMotion | None:
    """Fit shift and time offset; None with fewer than three windows whose shift can be measured.

    Args:
        sample: The frames read.
        speed: Result of ``image_speeds``.
    """
    scale = sample.camera.width / sample.depth_camera.width
    shifts, speeds, weights = [], [], []
    for window in _windows(sample, speed):
        edges = [depth_edges(f.depth_m.numpy()) for f in window]
        if sum(float(E.sum()) for E in edges) < _EDGES * len(window):
            continue
        surface = shift_surface(edges, [colour_contrast(f.grey, edges[0].shape) for f in window])
        _, height, shift = peak_of(surface)
        if height >= _CLEAR:
            shifts.append(shift)
            speeds.append(np.mean([speed[f.place] for f in window], axis=0))
            weights.append(height - _CLEAR + 0.5)
    if len(shifts) < 3:
        return None
    x, lag, errors = line_through(np.array(shifts), np.array(speeds), np.array(weights))
    return ColourMotion(
        shift_px=(x[0] * scale, x[1] * scale),
        shift_error_px=errors[0] * scale,
        lag_frames=lag,
        lag_error_frames=errors[1],
        speed_px=float(np.linalg.norm(speeds, axis=1).max()) * scale,
        windows=len(shifts),
        separable=_separable(np.array(speeds)),
    )


def _separable(speeds: Float[np.ndarray, "W 2"]) -> bool:
    """Whether the speeds along the main direction go down to a quarter of the largest, or change their sign."""
    main = speeds @ np.linalg.svd(speeds, full_matrices=False)[2][0]
    fast = float(np.abs(main).max())
    return bool(np.abs(main).min() < fast / 4 or (main.min() < -fast / 4 and main.max() > fast / 4))


def line_through(
    shifts: Float[np.ndarray, "W 2"], speeds: Float[np.ndarray, "W 2"], weights: Float[np.ndarray, " W"]
) -> tuple[tuple[float, float], float, tuple[float, float]]:
    """Constant shift, slope over the speed, and their standard errors, by weighted least squares without outliers.

    The slope is held near 0 by ``_LAG_PRIOR``: without a change of speed the shift is then constant, but its error says
    that a time offset may be part of it.
    """
    n = len(shifts)
    A = np.zeros((2 * n, 3))
    A[:n, 0], A[n:, 1], A[:, 2] = 1.0, 1.0, speeds.T.ravel()
    b, w = shifts.T.ravel(), np.tile(weights, 2)
    x = np.zeros(3)
    for _ in range(4):
        noise = max(float(np.sqrt((w * (A @ x - b) ** 2).sum() / w.sum())), 0.3) if _ else 1.0
        H = (A * w[:, None]).T @ A / noise**2 + np.diag([1e-6, 1e-6, _LAG_PRIOR**-2])
        x = np.linalg.solve(H, (A * w[:, None]).T @ b / noise**2)
        far = np.abs(A @ x - b)
        w = np.tile(weights, 2) / np.maximum(1.0, far / max(1.5 * float(np.median(far)), 0.5)) ** 2
    errors = np.sqrt(np.diag(np.linalg.inv(H)))
    return (float(x[0]), float(x[1])), float(x[2]), (float(errors[:2].max()), float(errors[2]))


def image_speeds(sample: Sample) -> dict[int, Float[np.ndarray, " 2"]]:
    """Motion of the colour image's content by position, right and down, pixels of the small depth images per frame."""
    there, found = sample.by_place, {}
    for f in sample.frames:
        steps = [(there[p], there[p + 1]) for p in (f.place - 1, f.place) if p in there and p + 1 in there]
        if steps:
            found[f.place] = np.mean([_moved(a, b) for a, b in steps], axis=0)
    return found


def moving_together(sample: Sample, speed: abc.Mapping[int, np.ndarray]) -> float | None:
    """Correlation of the motion of colour with that of the depth edges, -1..1; None if the images hardly move."""
    there = sample.by_place
    places = [p for p in sorted(speed) if p + 1 in there][:60]
    if len(places) < 8:
        return None
    colour = np.array([_moved(there[p], there[p + 1]) for p in places]).ravel()
    depth = np.array([_phase(*(_edge_image(there[q]) for q in (p, p + 1))) for p in places]).ravel()
    if float(np.abs(colour).mean()) < 0.3:
        return None
    return float((colour * depth).sum() / max(float(np.linalg.norm(colour) * np.linalg.norm(depth)), 1e-9))


def _edge_image(f: FrameFacts) -> Float[np.ndarray, "h w"]:
    """Depth edges, blurred so that ragged ones still match."""
    import cv2

    return np.asarray(cv2.GaussianBlur(depth_edges(f.depth_m.numpy()), (0, 0), 2.0))


def _phase(first: np.ndarray, second: np.ndarray) -> Float[np.ndarray, " 2"]:
    """Shift of the content from the first image to the second by phase correlation, pixels."""
    import cv2

    window = cv2.createHanningWindow(first.shape[1::-1], cv2.CV_32F)
    return np.array(cv2.phaseCorrelate(first, second, window)[0])


def _moved(a: FrameFacts, b: FrameFacts) -> Float[np.ndarray, " 2"]:
    """Shift of the content from ``a`` to ``b`` by phase correlation, pixels of the depth images."""
    import cv2

    first, second = (cv2.GaussianBlur(f.grey.astype(np.float32), (0, 0), 1.5) for f in (a, b))
    return _phase(first, second) * (a.depth_m.shape[1] / first.shape[1])


def _windows(sample: Sample, speed: abc.Mapping[int, np.ndarray]) -> list[list[FrameFacts]]:
    """Windows of consecutive frames: spread over the sample, and the fastest in each direction."""
    there = sample.by_place
    whole = [
        [there[p] for p in range(f.place, f.place + WINDOW)]
        for f in sample.frames[::WINDOW]
        if all(p in there and p in speed for p in range(f.place, f.place + WINDOW))
    ]
    if len(whole) <= _WINDOWS:
        return whole
    mean = np.array([np.mean([speed[f.place] for f in window], axis=0) for window in whole])
    chosen = {int(i) for i in np.linspace(0, len(whole) - 1, _WINDOWS // 2).round()}
    for axis in (0, 1):
        order = np.argsort(mean[:, axis])
        chosen |= {int(i) for i in (*order[:2], *order[-2:])}
    return [whole[i] for i in sorted(chosen)]
