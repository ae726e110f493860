"""Checks of the pose found by ICP. Each returns the reason to reject it, as the end of a sentence, or ""."""

from torch import Tensor

from ..config import TrackingConfig
from ..geometry import se3
from ..types import Frame
from .appearance import SAME_PLACE, correlation
from .icp import IcpResult
from .surface import Surface

RECOVERED_SHARE = 0.3
RECOVERED_OVERLAP_SHARE = 0.6
"""After a failed prediction a pose must fit this well, and in every direction of motion: one of several starts may fit
by chance, and a wrong pose would damage the map permanently."""


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
