"""Checks of the pose found by ICP. Each returns the reason to reject it, as the end of a sentence, or ""."""

import math
import statistics

import torch
from torch import Tensor

from ..checks import check_saved
from ..config import TrackingConfig
from ..geometry import se3
from ..types import Frame
from .appearance import SAME_PLACE, correlation
from .attempt import Attempt, Sight
from .brightness import Pictures
from .icp import IcpResult
from .normal_equations import icp_system
from .surface import Surface

RECOVERED_SHARE = 0.3
RECOVERED_OVERLAP_SHARE = 0.6
"""After a failed prediction a pose must fit this well, and in every direction of motion: one of several starts may fit
by chance, and a wrong pose would damage the map permanently."""

USUAL_FRAMES = 15
"""A fit is compared with those of this many frames before it,"""
LEAST_FRAMES = 5
"""but not before there are this many."""
UNUSUAL_RMS = 2.0
UNUSUAL_SHARE = 0.6
"""A fit is doubtful if its distances are this many times as large as usual, or if less than this share of the usual
pixels fit."""

CLEARLY_BETTER = 0.9
"""Another pose is preferred to a doubtful one only if its cost is below this share of it."""

COST_GATE_M = 0.03
"""Larger distances from the model count as this much when two fits are compared, metres."""


class UsualFit:
    """How well the last frames fitted: a sudden change for the worse is often a wrong pose."""

    def __init__(self, fits: list[tuple[float, float]] | None = None):
        self.fits = fits or []
        """rms_m and inlier_share of the last frames."""

    def copy(self) -> "UsualFit":
        """The same, unchanged by what is added later."""
        return UsualFit(list(self.fits))

    def add(self, result: IcpResult) -> None:
        """Remember the fit of one more frame."""
        self.fits = [*self.fits, (result.rms_m, result.inlier_share)][-USUAL_FRAMES:]

    def why_unusual(self, result: IcpResult) -> str:
        """The reason to doubt a fit that passed all limits, or ""."""
        if len(self.fits) < LEAST_FRAMES:
            return ""
        rms_m, share = (statistics.median(values) for values in zip(*self.fits, strict=True))
        if result.rms_m > UNUSUAL_RMS * rms_m:
            return f"its points lie {result.rms_m * 1e3:.1f} mm from the model, usually {rms_m * 1e3:.1f} mm"
        if result.inlier_share < UNUSUAL_SHARE * share:
            return f"{result.inlier_share:.0%} of its pixels fit the model, usually {share:.0%}"
        return ""

    def state(self) -> Tensor:
        """For a checkpoint."""
        return torch.tensor(self.fits, dtype=torch.float64).view(-1, 2)

    @classmethod
    def of_state(cls, state: Tensor | None) -> "UsualFit":
        """What ``state`` saved; empty from an older checkpoint."""
        if state is None:
            return cls()
        check_saved("the fits of the tracker's last frames", state, ("N", 2), torch.float64)
        return cls([(float(rms_m), float(share)) for rms_m, share in state])


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

    Every usable pixel of the frame counts, those that fit nothing with ``COST_GATE_M``, so that poses can be compared.
    """
    level, surface = sight.levels[-1], against.surface
    T_WC = result.T_WC.to(surface.depth_m.device)
    gates = {"max_distance_m": COST_GATE_M, "min_cosine": math.cos(math.radians(config.max_angle_deg))}
    system = icp_system(level, T_WC, surface, **gates)
    missed = (result.n_pixels - system.n_inliers) * COST_GATE_M**2
    error = (system.sum_squares_m2 + missed) / max(result.n_pixels, 1)
    pictures = Pictures.of(sight.brightness, surface) if sight.brightness else None
    if pictures is not None and config.brightness_m:
        for _ in range(2):  # the second time with the exposure that the first has found
            seen = pictures.system(level, T_WC, COST_GATE_M)
        error += (config.brightness_m * seen.rms) ** 2
    return error


def why_no_fit(result: IcpResult, config: TrackingConfig, *, strict: bool) -> str:
    """The reason why the frame does not fit the model. ``strict``: with the limits after a failed prediction."""
    share = max(config.min_inliers, RECOVERED_SHARE if strict else 0)
    overlap_share = max(config.min_overlap_inliers, RECOVERED_OVERLAP_SHARE if strict else 0)
    if result.inlier_share < share:
        return f"{result.inlier_share:.0%} of its pixels fit the model (at least {share:.0%} needed)"
    if result.overlap_inlier_share < overlap_share:
        fit = f"{result.overlap_inlier_share:.0%} of its pixels that meet the model fit it"
        return f"{fit} (at least {overlap_share:.0%} needed)"
    if not result.rms_m <= config.max_rms_m:
        return f"its points lie {result.rms_m * 100:.1f} cm from the model (at most {config.max_rms_m * 100:g} cm)"
    if strict and result.degenerate:
        return f"{result.degenerate} of 6 directions of motion are not determined"
    return ""


def why_too_far(last: Tensor, T_WC: Tensor, config: TrackingConfig, *, frames: int) -> str:
    """The reason why the camera cannot have moved from ``last`` to ``T_WC`` [4, 4] in this number of frames."""
    step = se3.inverse(last) @ T_WC
    moved_m, turned_deg = float(step[:3, 3].norm()), float(se3.rotation_angle(step[:3, :3]).rad2deg())
    most_m, most_deg = frames * config.max_step_m, frames * config.max_step_deg
    if moved_m > most_m or turned_deg > most_deg:
        return (
            f"it would have moved {moved_m:.2f} m and turned {turned_deg:.0f} degrees since the last one (at most "
            f"{most_m:g} m and {most_deg:g} degrees)"
        )
    return ""


def why_not_alike(frame: Frame, surface: Surface) -> str:
    """The reason why the frame does not look like the model seen from its pose."""
    likeness = correlation(frame, surface)
    if likeness is None or likeness >= SAME_PLACE:
        return ""
    return f"it looks different there (correlation {likeness:.2f}, at least {SAME_PLACE:g} needed)"
