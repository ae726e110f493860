"""What GPS-SLAM does with its Gaussians between the rounds of its optimisation."""

from typing import Any

from ..gaussians import restart_optimiser
from .lost_rows import remove_lost

LEAST_OPACITY = 0.005
"""Gaussians with a smaller opacity are removed (released code)."""


def begin_round(mapper: Any) -> None:
    """Remove Gaussians and forget all moments and the number of steps, where the settings say so.

    Args:
        mapper: The ``GPSSLAM``.
    """
    if mapper.config.schedule.spread:
        remove_useless(mapper)
    if mapper.config.residual.restart_adam:
        mapper.parts.take_missed_steps()
        mapper.gaussians.undo_log.will_change()
        restart_optimiser(mapper.gaussians)


def remove_useless(mapper: Any) -> None:
    """Remove Gaussians that have become too small, too large or transparent.

    Args:
        mapper: The ``GPSSLAM``.
    """
    mapper.parts.take_missed_steps()
    remove_lost(mapper)
    limits = mapper.config.residual
    params = mapper.gaussians.params
    radius_m = params.log_scale.amax(dim=1).exp()
    is_useful = (radius_m >= limits.min_radius_m) & (radius_m <= limits.max_radius_m)
    is_useful &= params.opacity_logit.sigmoid() >= LEAST_OPACITY
    if not bool(is_useful.all()):
        mapper.gaussians.undo_log.will_change()
        mapper.gaussians.keep(is_useful)
