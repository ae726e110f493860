"""Whether colour edges lie on depth edges; searched over shift, scale, mirroring and whole frames
of time."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from .edges import colour_contrast, depth_edges, on_edges
from .sample import FrameFacts, Sample

REACH_PX = 24
"""Largest shift that is searched, pixels of the small images."""

ANCHORS = 12

TIME_REACH = 4

_SCALES = (0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08, 1.12, 1.16)

_EDGES = 60
"""Fewest pixels on edges per frame."""

_AS_WELL = 3.0

_BETTER = 1.15
"""Another score is accepted if it is this much higher than the score as read."""

_REGISTERED_SCORE = 0.6
"""Smallest score of another time that is accepted: the right time has 0.74 to 1.56, and the best of
several wrong ones up to 0.41."""


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
    """Mean colour contrast on the depth edges under the best of all these, relative to the
    neighbourhood."""
    peak: float
    """How many standard deviations the best shift is above the others."""
    pixel: float
    """Size of a compared pixel, pixels of the full image."""
    may_be_time: bool = False
    """Whether a time offset of up to half a frame explains the shifts of the single frames as
    well."""


def fit_colour(sample: Sample) -> ColourFit | None:
    """Find the position of colour relative to depth; None with fewer than 60 edge pixels per frame.

    A shift is measured where the image moves slowly, and a time where it moves fast: in one stretch
    of even motion both look the same.
    """
    slow, fast = _anchors(sample)
    edges = [depth_edges(f.depth_m.numpy()) for f in slow]
    if not edges or np.mean([e.sum() for e in edges]) < _EDGES:
        return None
    plain = [colour_contrast(f.grey, e.shape) for f, e in zip(slow, edges, strict=True)]
    transforms = _transforms(plain)
    speeds = [_speed(f, sample.by_place) for f in slow]
    spatial = _surface(edges, transforms)
    best_time, time_score, now_score = _best_time(fast, sample.by_place)
    options = [(*_scaled_peak(edges, transforms), "none")]
    for name, flip in (("x", np.s_[:, ::-1]), ("y", np.s_[::-1]), ("xy", np.s_[::-1, ::-1])):
        surface = _surface(edges, _transforms([g[flip] for g in plain]))
        options.append((*peak_of(surface), 1.0, name))
    score, peak, shift, scale, mirror = max(
        options, key=lambda o: o[0] * (1 if o[4] == "none" else 0.7)
    )
    near_score, _, near_shift = peak_of(spatial, reach=1)
    frames = 0
    if mirror == "none" and score < _BETTER * near_score:  # within the noise: keep as read
        score = near_score
        shift = near_shift
        scale = 1.0
    least_time_score = max(_BETTER * now_score, 0.9 * score, _REGISTERED_SCORE)
    if best_time and time_score > least_time_score:
        score = time_score
        shift = (0.0, 0.0)
        scale = 1.0
        mirror = "none"
        frames = best_time
    small = sample.camera.width / edges[0].shape[1]
    # a subsampled depth pixel is at the centre of its cell only if the step is odd
    offset = 0.5 if round(small) % 2 == 0 and not frames else 0.0
    return ColourFit(
        shift_px=(shift[0] * small + offset, shift[1] * small + offset),
        scale=scale,
        mirror=mirror,
        shift_frames=frames,
        score=score,
        peak=peak,
        pixel=small,
        may_be_time=_may_be_time(
            [peak_of(_surface([E], [G]))[2] for E, G in zip(edges, transforms, strict=True)], speeds
        ),
    )


def _may_be_time(
    shifts: list[tuple[float, float]],
    speeds: list[np.ndarray],
) -> bool:
    """Whether shifts in single frames are as near to a multiple of the image's speed as to their
    median."""
    s = np.array(shifts)
    v = np.array(speeds)
    lag = np.clip(
        (s * v).sum() / max((v * v).sum(), 1e-9),
        -0.5,
        0.5,
    )
    off_time, off_shift = (
        np.median(np.linalg.norm(s - x, axis=1)) for x in (lag * v, np.median(s, axis=0))
    )
    return bool(off_time < _AS_WELL * max(off_shift, 0.5))


def _speed(
    f: FrameFacts,
    by_place: dict[int, FrameFacts],
) -> Float[np.ndarray, " 2"]:
    """Motion of the image's content from this frame to the next by phase correlation, pixels of the
    depth images."""
    previous, following = _neighbours(f, by_place)
    a, b = (cv2.GaussianBlur(g.grey.astype(np.float32), (0, 0), 1.5) for g in (previous, following))
    shift_px = cv2.phaseCorrelate(
        a,
        b,
        cv2.createHanningWindow(a.shape[1::-1], cv2.CV_32F),
    )[0]
    return np.array(shift_px) * (f.depth_m.shape[1] / a.shape[1])


def _neighbours(f: FrameFacts, by_place: dict[int, FrameFacts]) -> tuple[FrameFacts, FrameFacts]:
    """The frame and the next, or the one before and the frame if the next was not read; itself
    twice without both."""
    if f.place + 1 in by_place:
        return f, by_place[f.place + 1]
    return by_place.get(f.place - 1, f), f


def _anchors(sample: Sample) -> tuple[list[FrameFacts], list[FrameFacts]]:
    """Of each of a few stretches the frame in which the image moves slowest, and the one in which
    it moves fastest."""
    by_place = sample.by_place
    inner = [
        f for f in sample.frames if all(f.place + k in by_place for k in (-TIME_REACH, TIME_REACH))
    ]
    candidates = inner or sample.frames

    def motion(f: FrameFacts) -> float:
        previous, following = _neighbours(f, by_place)
        return float(np.abs(following.grey.astype(np.float32) - previous.grey).mean())

    stretches = [part for part in np.array_split(np.arange(len(candidates)), ANCHORS) if len(part)]
    by_motion = [sorted((candidates[i] for i in part), key=motion) for part in stretches]
    return [part[0] for part in by_motion], [part[-1] for part in by_motion]


def _transforms(contrast: list[np.ndarray]) -> list[np.ndarray]:
    """Fourier transforms of the contrast images without their mean, padded for the shifts."""
    return [np.fft.rfft2(G - G.mean(), _size(G.shape)) for G in contrast]


def _size(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(cv2.getOptimalDFTSize(n + 2 * REACH_PX) for n in shape)


def _surface(
    edges: list[np.ndarray],
    transforms: list[np.ndarray],
) -> np.ndarray:
    """Mean contrast on the edges for every shift of the contrast images, minus the mean contrast of
    all pixels. [2R+1, 2R+1]"""
    R = REACH_PX
    size = _size(edges[0].shape)
    products = [np.conj(np.fft.rfft2(E, size)) * G for E, G in zip(edges, transforms, strict=True)]
    total = np.fft.irfft2(sum(products), size)
    return np.roll(total, (R, R), (0, 1))[: 2 * R + 1, : 2 * R + 1] / max(
        sum(float(E.sum()) for E in edges), 1.0
    )


def peak_of(
    surface: np.ndarray,
    reach: int = REACH_PX,
) -> tuple[float, float, tuple[float, float]]:
    """Height, height in standard deviations, and position of the highest peak, to fractions of a
    pixel by parabolas.

    Only shifts of at most ``reach`` pixels are searched.
    """
    low = REACH_PX - reach
    middle = surface[low : REACH_PX + reach + 1, low : REACH_PX + reach + 1]
    j, i = (int(x) + low for x in np.unravel_index(int(middle.argmax()), middle.shape))
    peak = float((surface[j, i] - surface.mean()) / (surface.std() + 1e-9))
    place = []
    for at, line in ((i, surface[j]), (j, surface[:, i])):
        d = 0.0
        if 0 < at < len(line) - 1:
            bend = line[at - 1] - 2 * line[at] + line[at + 1]
            d = (
                float(
                    np.clip(
                        0.5 * (line[at - 1] - line[at + 1]) / bend,
                        -1,
                        1,
                    )
                )
                if bend < 0
                else 0.0
            )
        place.append(float(at + d - REACH_PX))
    return float(surface[j, i]), peak, (place[0], place[1])


def _scaled_peak(
    edges: list[np.ndarray], transforms: list[np.ndarray]
) -> tuple[float, float, tuple[float, float], float]:
    """The best peak over scales of the colour image, in two rounds."""

    def at(scale: float) -> tuple[float, float, tuple[float, float], float]:
        return (*peak_of(_surface([_scaled(E, scale) for E in edges], transforms)), scale)

    best = max((at(s) for s in _SCALES), key=lambda t: t[0])
    for step in (0.02, 0.01, 0.005):
        best = max(
            (best, at(best[3] - step), at(best[3] + step)),
            key=lambda t: t[0],
        )
    return best


def _scaled(E: np.ndarray, scale: float) -> np.ndarray:
    if scale == 1.0:
        return E
    h, w = E.shape
    y, x = np.nonzero(E)
    x = np.rint((x - (w - 1) / 2) * scale + (w - 1) / 2).astype(int)
    y = np.rint((y - (h - 1) / 2) * scale + (h - 1) / 2).astype(int)
    is_inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    result = np.zeros_like(E)
    result[y[is_inside], x[is_inside]] = 1
    return result


def _best_time(
    anchors: list[FrameFacts],
    by_place: dict[int, FrameFacts],
) -> tuple[int, float, float]:
    """The frame whose colour fits best without a shift in the image, its score, and that of the
    frame itself."""
    edges = {f.place: depth_edges(f.depth_m.numpy()) for f in anchors}
    scores = {0: 0.0}
    for k in range(-TIME_REACH, TIME_REACH + 1):
        both = [(edges[f.place], by_place[f.place + k]) for f in anchors if f.place + k in by_place]
        if len(both) >= max(1, len(anchors) // 2):
            scores[k] = on_edges(*zip(*both, strict=True))
    best = max(scores, key=scores.__getitem__)
    return best, scores[best], scores[0]
