"""How near to a camera the Gaussians of a map are drawn."""

from typing import Any

from .constants import NEAR_PLANE_M

LEAST_PLANE_M = 0.01
"""A Gaussian nearer than this covers the whole picture, metres."""


def near_plane_m(config: Any) -> float:
    """Gaussians whose centre is not deeper than this are not drawn, metres: the published 0.2, or
    the nearest depth that is mapped where that is less. Otherwise what is mapped there would be
    missing in every picture, and the depth in the loss would push Gaussians out of sight.

    Args:
        config: Settings of a system. The nearest depth is ``tsdf.near_m``, and ``data.depth_min_m``
            of a system without a TSDF (RTG-SLAM); where that is 0, no limit, the plane is the
            published one.
    """
    tsdf = getattr(config, "tsdf", None)
    if tsdf is not None:
        nearest_m = max(LEAST_PLANE_M, tsdf.near_m)
    else:
        nearest_m = config.data.depth_min_m or NEAR_PLANE_M
    return min(NEAR_PLANE_M, nearest_m)


def near_plane_option(near_m: float) -> dict[str, float]:
    """``near_m`` as an argument of ``project_gaussians`` and its gradient; none for the published
    plane, because a learner's function has only that of the course."""
    return {} if near_m == NEAR_PLANE_M else {"near_m": near_m}
