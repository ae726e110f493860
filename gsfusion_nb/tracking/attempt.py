"""One attempt to find the pose of a frame: where ICP starts, what it leads to, and whether that is
accepted."""

import dataclasses
import math
import statistics
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..config import TrackingConfig
from ..geometry import se3, sum_rows
from ..types import Frame
from .brightness import Pictures, brightness_levels
from .icp import ExtraRows, IcpResult, align
from .icp_system import icp_system
from .surface import DepthLevel, Surface, SurfaceSource, depth_pyramid, smooth_normals

WIDE_DISTANCE = 3.0
WIDE_ANGLE_DEG = 60.0
"""ICP from a wide start allows this many times the distance and normals at up to this angle: on the
coarse levels it finds a pose that the usual limits then refine."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame prepared for ICP."""

    frame: Frame
    levels: list[DepthLevel]
    brightness: dict[int, Tensor]
    """Factor of each level -> brightness; empty if it is not used."""
    extra: ExtraRows | None = None
    """Further rows of its least squares."""

    @classmethod
    def of(cls, frame: Frame, config: TrackingConfig, extra: ExtraRows | None = None) -> "Sight":
        """The frame at all levels of the pyramid."""
        levels = depth_pyramid(frame.depth_m, frame.camera, config.pyramid)
        brightness = brightness_levels(frame.rgb, config.pyramid) if config.brightness_m else {}
        return cls(frame, levels, brightness, extra)

    @property
    def has_depth(self) -> bool:
        """Whether any pixel of the finest level is usable."""
        return bool((self.levels[-1].depth_m > 0).any())


@dataclass(frozen=True, eq=False)
class Start:
    """A starting pose of ICP."""

    name: str
    T_WC: Float[Tensor, "4 4"]
    wide: bool = False
    """Use wide limits of distance and angle first."""
    smooth: bool = False
    """Average the model's normals over their neighbours."""
    anywhere: bool = False
    """It may be far from the last pose."""
    extra: ExtraRows | None = None
    """Rows of the landmarks that agree with this pose: it need not fit as well as one that nothing
    else confirms."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """What ICP made of a start."""

    start: Start
    surface: Surface
    """The surface that the frame was aligned with."""
    result: IcpResult


def attempt(
    sight: Sight, source: SurfaceSource, mixed: SurfaceSource, start: Start, config: TrackingConfig
) -> Attempt:
    """Align a frame from one start.

    Args:
        sight: The frame.
        source: Renders the model.
        mixed: Renders the target of the settings, which may be mixed with the last frame.
        start: Where to start; from a wide one, or one that may be anywhere, the model alone is
            used.
        config: Pyramid levels and limits.
    """
    T_WC = start.T_WC
    camera = sight.frame.camera
    if start.wide:
        surface = source(camera, T_WC.float())
        T_WC = align(
            sight.levels[:-1] or sight.levels,
            surface,
            T_WC,
            _widened(config),
        ).T_WC
    surface = (source if start.wide or start.anywhere else mixed)(camera, T_WC.float())
    if start.smooth:
        surface = smooth_normals(surface)
    pictures = Pictures.of(sight.brightness, surface) if sight.brightness else None
    return Attempt(
        start, surface, align(sight.levels, surface, T_WC, config, sight.extra, pictures)
    )


def _widened(config: TrackingConfig) -> TrackingConfig:
    coarse = config.pyramid[:-1] or config.pyramid
    return dataclasses.replace(
        config,
        pyramid=coarse,
        iterations=tuple(4 * n for n in config.iterations[: len(coarse)]),
        max_distance_m=WIDE_DISTANCE * config.max_distance_m,
        max_angle_deg=max(WIDE_ANGLE_DEG, config.max_angle_deg),
    )


SAME_PLACE = 0.6
"""Smallest correlation of brightness where camera and model see the same surface. In the built-in
room it is at least 0.94 at the true pose, and mostly below 0.5 at the poses of other frames."""
DOUBTFUL_PLACE = 0.8
"""The same for a fit that is worse than usual. Where frames of four recordings were left out, such
fits had 0.87 or more near the true pose, and 0.63 or less a metre from it."""
SAME_SURFACE_M = 0.05
"""Largest difference of depth at which camera and model see the same surface, metres."""
ENOUGH_PIXELS = 100
"""Smallest number of such pixels."""


def correlation(frame: Frame, surface: Surface) -> float | None:
    """Correlation of the frame's brightness with the model's, over the pixels that both see at the
    same depth.

    Args:
        frame: The frame.
        surface: The model seen from the pose to test, with colours, at the frame's size.

    Returns:
        -1 to 1; ``None`` if the model has no colours, too few pixels are shared, or an image is
        uniform there.
    """
    if surface.rgb is None or surface.depth_m.shape != frame.depth_m.shape:
        return None
    both = (surface.depth_m > 0) & (frame.depth_m > 0)
    both &= (surface.depth_m - frame.depth_m).abs() < SAME_SURFACE_M
    if int(both.sum()) < ENOUGH_PIXELS:
        return None
    a = frame.rgb[both].mean(dim=-1)
    b = surface.rgb[both].mean(dim=-1)
    a = a - sum_rows(a) / len(a)
    b = b - sum_rows(b) / len(b)
    norm = float((sum_rows(a * a) * sum_rows(b * b)).sqrt())
    return float(sum_rows(a * b)) / norm if norm > 1e-3 else None


MIN_SHARE = 0.15
MIN_OVERLAP_SHARE = 0.4
MAX_RMS_M = 0.02
"""Tracking fails if less than these shares of the pixels with depth, and of those that fall on a
known part of the model, found a corresponding point, or if their distances are larger, metres.
Correctly tracked frames had an overlap share of 0.53 or more; of 390 frames started at the pose of
another place, 15 reached more than 0.4."""

RECOVERED_SHARE = 0.3
RECOVERED_OVERLAP_SHARE = 0.6
"""After a failed prediction a pose must fit this well, and in every direction of motion: one of
several starts may fit by chance, and a wrong pose would damage the map permanently."""

USUAL_FRAMES = 15
"""A fit is compared with those of this many frames before it,"""
LEAST_FRAMES = 5
"""but not before there are this many."""
UNUSUAL_RMS = 2.0
UNUSUAL_SHARE = 0.6
"""A fit is doubtful if its distances are this many times as large as usual, or if less than this
share of the usual pixels fit."""

CLEARLY_BETTER = 0.9
"""Another pose is preferred to a doubtful one only if its cost is below this share of it."""

COST_GATE_M = 0.03
"""Larger distances from the model count as this much when two fits are compared, metres."""


class UsualFit:
    """How well the last frames fitted: a sudden change for the worse is often a wrong pose."""

    def __init__(self):
        self.fits: list[tuple[float, float]] = []
        """rms_m and inlier_share of the last frames; ``add`` makes another list."""

    def add(self, result: IcpResult) -> None:
        """Remember the fit of one more frame."""
        self.fits = [*self.fits, (result.rms_m, result.inlier_share)][-USUAL_FRAMES:]

    def why_unusual(self, result: IcpResult) -> str:
        """The reason to doubt a fit that passed all limits, or ""."""
        if len(self.fits) < LEAST_FRAMES:
            return ""
        rms_m, share = (statistics.median(values) for values in zip(*self.fits, strict=True))
        if result.rms_m > UNUSUAL_RMS * rms_m:
            return (
                f"its points lie {result.rms_m * 1e3:.1f} mm from the model, usually "
                f"{rms_m * 1e3:.1f} mm"
            )
        if result.inlier_share < UNUSUAL_SHARE * share:
            return f"{result.inlier_share:.0%} of its pixels fit the model, usually {share:.0%}"
        return ""


def best_of(sight: Sight, fits: list[Attempt], config: TrackingConfig) -> Attempt:
    """The first of several attempts, unless the cheapest of the others is clearly better."""
    first, *others = fits
    if not others:
        return first
    costs = [cost(sight, fit.result, first, config) for fit in fits]
    least = min(costs[1:])
    return others[costs.index(least, 1) - 1] if least < CLEARLY_BETTER * costs[0] else first


def cost(sight: Sight, result: IcpResult, against: Attempt, config: TrackingConfig) -> float:
    """Mean square error of a pose of the frame against the surface of one attempt, metres squared.

    Every usable pixel of the frame counts, those that fit nothing with ``COST_GATE_M``, so that
    poses can be compared.
    """
    level = sight.levels[-1]
    surface = against.surface
    T_WC = result.T_WC.to(surface.depth_m.device)
    gates = {
        "max_distance_m": COST_GATE_M,
        "min_cosine": math.cos(math.radians(config.max_angle_deg)),
    }
    system = icp_system(level, T_WC, surface, **gates)
    gap_cost = (result.n_pixels - system.n_inliers) * COST_GATE_M**2
    error = (system.sum_squares_m2 + gap_cost) / max(result.n_pixels, 1)
    pictures = Pictures.of(sight.brightness, surface) if sight.brightness else None
    if pictures is not None and config.brightness_m:
        for _ in range(2):  # the second time with the exposure that the first has found
            picture_system = pictures.system(level, T_WC, COST_GATE_M)
        error += (config.brightness_m * picture_system.rms) ** 2
    return error


def why_no_fit(result: IcpResult, *, strict: bool) -> str:
    """The reason why the frame does not fit the model. ``strict``: with the limits after a failed
    prediction."""
    share = RECOVERED_SHARE if strict else MIN_SHARE
    overlap_share = RECOVERED_OVERLAP_SHARE if strict else MIN_OVERLAP_SHARE
    if result.inlier_share < share:
        return (
            f"{result.inlier_share:.0%} of its pixels fit the model (at least {share:.0%} needed)"
        )
    if result.overlap_inlier_share < overlap_share:
        fit = f"{result.overlap_inlier_share:.0%} of its pixels that meet the model fit it"
        return f"{fit} (at least {overlap_share:.0%} needed)"
    if not result.rms_m <= MAX_RMS_M:
        return (
            f"its points lie {result.rms_m * 100:.1f} cm from the model (at most "
            f"{MAX_RMS_M * 100:g} cm)"
        )
    if strict and result.degenerate:
        return f"{result.degenerate} of 6 directions of motion are not determined"
    return ""


def why_too_far(last: Tensor, T_WC: Tensor, config: TrackingConfig, *, frames: int) -> str:
    """The reason why the camera cannot have moved from ``last`` to ``T_WC`` [4, 4] in this number
    of frames."""
    step = se3.inverse(last) @ T_WC
    moved_m = float(step[:3, 3].norm())
    turned_deg = float(se3.rotation_angle(step[:3, :3]).rad2deg())
    most_m = frames * config.max_step_m
    most_deg = frames * config.max_step_deg
    if moved_m > most_m or turned_deg > most_deg:
        return (
            f"it would have moved {moved_m:.2f} m and turned {turned_deg:.0f} degrees since the "
            f"last one (at most {most_m:g} m and {most_deg:g} degrees)"
        )
    return ""


def why_not_alike(frame: Frame, surface: Surface, *, doubtful: bool) -> str:
    """The reason why the frame does not look like the model seen from its pose. ``doubtful``: its
    fit is unusual."""
    least = DOUBTFUL_PLACE if doubtful else SAME_PLACE
    likeness = correlation(frame, surface)
    if likeness is None or likeness >= least:
        return ""
    return f"it looks different there (correlation {likeness:.2f}, at least {least:g} needed)"
