"""Whether colour edges lie on depth edges; searched over shift, scale, mirroring and time.

Is colour shifted against depth, or was it taken at another time? In one stretch of even motion both look the same: the
colour edges lie beside the depth edges. But a shift stays where it is, and a time offset moves the edges with the speed
of the image. So the shift is measured in several short windows and fitted by a line over the image's speed: its
constant part is a shift, its slope a time.
"""

from collections import abc
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from .sample import FrameFacts, Sample

REACH_PX = 24
"""Largest shift that is searched, pixels of the small images."""
ANCHORS = 12
TIME_REACH = 4
JUMP = 0.08
"""A pixel is on an edge if it is nearer than its neighbour by this share of its depth."""
_SCALES = (0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08, 1.12, 1.16)
_BETTER = 1.15
"""Another score is accepted if it is this much higher than the score as read."""


@dataclass(frozen=True, kw_only=True)
class ColourFit:
    """Position of the colour images relative to the depth images."""

    shift_px: tuple[float, float]
    """Shift of the colour image relative to depth, right and down, pixels of the full image."""
    scale: float
    """Size of objects in colour / in depth, about the image centre."""
    mirror: str
    """"none", "x", "y" or "xy"."""
    shift_frames: int
    """The colour of frame i + this number fits the depth of frame i."""
    score: float
    """Mean colour contrast on the depth edges under the best of all these, relative to the neighbourhood."""
    score_as_read: float
    peak: float
    """How many standard deviations the best shift is above the others."""
    pixel: float
    """Size of a compared pixel, pixels of the full image."""


def fit_colour(sample: Sample) -> ColourFit | None:
    """Find the position of colour relative to depth; None with fewer than 60 edge pixels per frame."""
    anchors = _anchors(sample)
    edges = [depth_edges(f.depth_m.numpy()) for f in anchors]
    n = int(np.mean([e.sum() for e in edges])) if edges else 0
    if n < 60:
        return None
    there = sample.by_place
    contrast = {f.place: colour_contrast(f.grey, e.shape) for f, e in zip(anchors, edges, strict=True)}
    plain = [contrast[f.place] for f in anchors]
    transforms = _transforms(plain)
    spatial = _surface(edges, transforms)
    as_read = float(spatial[REACH_PX, REACH_PX])
    best_time, time_score = _best_time(edges, anchors, there)
    options = [(*_scaled_peak(edges, transforms), "none", 0)]
    for name, flip in (("x", np.s_[:, ::-1]), ("y", np.s_[::-1]), ("xy", np.s_[::-1, ::-1])):
        surface = _surface(edges, _transforms([g[flip] for g in plain]))
        options.append((*peak_of(surface), 1.0, name, 0))
    (score, peak, shift, scale, mirror, frames) = max(options, key=lambda o: o[0] * (1 if o[4] == "none" else 0.7))
    near, at_near = _near(spatial)
    if mirror == "none" and score < _BETTER * near:  # within the noise: keep as read
        score, shift, scale = near, at_near, 1.0
    if best_time and time_score > max(_BETTER * as_read, 0.9 * score):
        score, shift, scale, mirror, frames = time_score, (0.0, 0.0), 1.0, "none", best_time
    small = sample.camera.width / edges[0].shape[1]
    # a subsampled depth pixel is at the centre of its cell only if the step is odd
    offset = 0.5 if round(small) % 2 == 0 else 0.0
    return ColourFit(
        shift_px=(shift[0] * small + offset * (frames == 0), shift[1] * small + offset * (frames == 0)),
        scale=scale,
        mirror=mirror,
        shift_frames=frames,
        score=score,
        score_as_read=as_read,
        peak=peak,
        pixel=small,
    )


def in_order(sample: Sample) -> float | None:
    """Share of the frames whose most similar colour image, of all others read, is at most two frames away.

    None if the same holds for the nearest poses of fewer than 80 per cent: the camera stands still or turns back.
    """
    if len(sample.frames) < 10:
        return None
    places = np.array([f.place for f in sample.frames])
    colour = np.stack([_thumbnail(f.grey) for f in sample.frames])
    pose = np.stack([f.T_stored[:3].numpy().ravel() for f in sample.frames])
    shares = []
    for rows in (pose, colour):
        distance = ((rows[:, None] - rows[None]) ** 2).sum(-1)
        np.fill_diagonal(distance, np.inf)
        shares.append(float((np.abs(places - places[distance.argmin(1)]) <= 2).mean()))
    return shares[1] if shares[0] > 0.8 else None


def _thumbnail(grey: UInt8[np.ndarray, "H W"]) -> np.ndarray:
    """32 x 24 pixels of mean 0 and deviation 1."""
    import cv2

    small = cv2.resize(grey, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
    return (small - small.mean()) / (small.std() + 1e-6)


def depth_edges(depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """1 on pixels that are nearer than a neighbour by a depth jump, else 0.

    First, narrow holes are filled with the farther of their two sides: beside an object a structured-light camera does
        not measure the background, and the edge belongs to the object.
    """
    found = np.zeros(depth_m.shape, bool)
    for turned, out in ((depth_m, found), (depth_m.T, found.T)):
        filled = _closed(turned)
        a, b = filled[:, :-1], filled[:, 1:]
        known = (a > 0) & (b > 0)
        out[:, :-1] |= known & (b > a * (1 + JUMP))
        out[:, 1:] |= known & (a > b * (1 + JUMP))
    return found.astype(np.float32)


def colour_contrast(grey: UInt8[np.ndarray, "H W"], shape: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
    """Gradient of the grey image divided by its mean in the neighbourhood (so that texture has little weight), at most
    4."""
    import cv2

    image = grey.astype(np.float32)
    if image.shape != tuple(shape):
        image = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    size = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1))
    return np.asarray(np.minimum(size / (cv2.blur(size, (31, 31)) + 4), 4), dtype=np.float32)


def _closed(depth_m: np.ndarray, widest: int = 10) -> np.ndarray:
    """Image rows in which holes of at most ``widest`` pixels are filled with the farther side."""
    h, w = depth_m.shape
    column = np.arange(w)[None]
    left = np.maximum.accumulate(np.where(depth_m > 0, column, -w), axis=1)
    right = np.minimum.accumulate(np.where(depth_m > 0, column, 2 * w)[:, ::-1], axis=1)[:, ::-1]
    narrow = (depth_m <= 0) & (left >= 0) & (right < w) & (right - left <= widest)
    row = np.arange(h)[:, None]
    sides = depth_m[row, np.clip(left, 0, w - 1)], depth_m[row, np.clip(right, 0, w - 1)]
    return np.where(narrow, np.maximum(*sides), depth_m)


def _anchors(sample: Sample) -> list[FrameFacts]:
    """Frames spread over the sample, preferably those with neighbours in time."""
    there = sample.by_place
    inner = [f for f in sample.frames if all(f.place + k in there for k in (-TIME_REACH, TIME_REACH))]
    chosen = inner or sample.frames
    return (
        [chosen[i] for i in sorted({int(i) for i in np.linspace(0, len(chosen) - 1, ANCHORS).round()})]
        if chosen
        else []
    )


def shift_surface(edges: list[np.ndarray], contrast: list[np.ndarray]) -> np.ndarray:
    """Mean contrast of the colour images on the depth edges for every shift, above that of all pixels. [2R+1, 2R+1]"""
    return _surface(edges, _transforms(contrast))


def _transforms(contrast: list[np.ndarray]) -> list[np.ndarray]:
    """Fourier transforms of the contrast images without their mean, padded for the shifts."""
    return [np.fft.rfft2(G - G.mean(), _size(G.shape)) for G in contrast]


def _size(shape: tuple[int, ...]) -> tuple[int, ...]:
    import cv2

    return tuple(cv2.getOptimalDFTSize(n + 2 * REACH_PX) for n in shape)


def _surface(edges: list[np.ndarray], transforms: list[np.ndarray]) -> np.ndarray:
    """Mean contrast on the edges for every shift of the contrast images, minus the mean contrast of all pixels. [2R+1,
    2R+1]"""
    R, size = REACH_PX, _size(edges[0].shape)
    products = [np.conj(np.fft.rfft2(E, size)) * G for E, G in zip(edges, transforms, strict=True)]
    total = np.fft.irfft2(sum(products), size)
    return np.roll(total, (R, R), (0, 1))[: 2 * R + 1, : 2 * R + 1] / max(sum(float(E.sum()) for E in edges), 1.0)


def peak_of(surface: np.ndarray) -> tuple[float, float, tuple[float, float]]:
    """Height, height in standard deviations, and position of the highest peak, to fractions of a pixel by parabolas."""
    j, i = np.unravel_index(int(surface.argmax()), surface.shape)
    peak = float((surface[j, i] - surface.mean()) / (surface.std() + 1e-9))
    return float(surface[j, i]), peak, _top_of(surface, int(j), int(i))


def _top_of(surface: np.ndarray, j: int, i: int) -> tuple[float, float]:
    """Position of the peak at row ``j`` and column ``i``, to fractions of a pixel."""
    place = []
    for at, line in ((i, surface[j]), (j, surface[:, i])):
        d = 0.0
        if 0 < at < len(line) - 1:
            bend = line[at - 1] - 2 * line[at] + line[at + 1]
            d = float(np.clip(0.5 * (line[at - 1] - line[at + 1]) / bend, -1, 1)) if bend < 0 else 0.0
        place.append(float(at + d - REACH_PX))
    return place[0], place[1]


def _near(surface: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Height and position of the highest of the nine values around zero shift."""
    R = REACH_PX
    middle = surface[R - 1 : R + 2, R - 1 : R + 2]
    j, i = np.unravel_index(int(middle.argmax()), middle.shape)
    place = _top_of(surface, R - 1 + int(j), R - 1 + int(i))
    return float(middle[j, i]), place


def _scaled_peak(
    edges: list[np.ndarray], transforms: list[np.ndarray]
) -> tuple[float, float, tuple[float, float], float]:
    """The best peak over scales of the colour image, in two rounds."""

    def at(scale: float) -> tuple[float, float, tuple[float, float], float]:
        return (*peak_of(_surface([_scaled(E, scale) for E in edges], transforms)), scale)

    best = max((at(s) for s in _SCALES), key=lambda t: t[0])
    for step in (0.02, 0.01, 0.005):
        best = max((best, at(best[3] - step), at(best[3] + step)), key=lambda t: t[0])
    return best


def _scaled(E: np.ndarray, scale: float) -> np.ndarray:
    if scale == 1.0:
        return E
    h, w = E.shape
    y, x = np.nonzero(E)
    x = np.rint((x - (w - 1) / 2) * scale + (w - 1) / 2).astype(int)
    y = np.rint((y - (h - 1) / 2) * scale + (h - 1) / 2).astype(int)
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    out = np.zeros_like(E)
    out[y[inside], x[inside]] = 1
    return out


def _best_time(edges: list[np.ndarray], anchors: list[FrameFacts], there: dict[int, FrameFacts]) -> tuple[int, float]:
    """The frame whose colour fits best without a shift in the image, and its score."""
    scores = {}
    for k in range(-TIME_REACH, TIME_REACH + 1):
        both = [(E, there[f.place + k]) for E, f in zip(edges, anchors, strict=True) if f.place + k in there]
        if both and len(both) >= len(anchors) // 2:
            total = 0.0
            for E, f in both:
                G = colour_contrast(f.grey, E.shape)
                total += float((E * (G - G.mean())).sum() / max(E.sum(), 1))
            scores[k] = total / len(both)
    if not scores:
        return 0, 0.0
    best = max(scores, key=scores.__getitem__)
    return best, scores[best]


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
