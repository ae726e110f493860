"""Whether colour edges lie on depth edges; searched over shift, scale, mirroring and time."""

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
    edges: int
    """Depth edge pixels per frame."""
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
        edges=n,
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
