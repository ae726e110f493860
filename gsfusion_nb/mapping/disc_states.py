"""The states of RTG-SLAM's Gaussians: how they change after a frame, the number and share of each
over a run, and why none has become stable."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import torch

from ..backends import runs_learners_code
from ..config import RtgSlamConfig
from ..gaussians import Transitions
from ..gaussians.surfel_states import change_states, count_errors, count_views, state_counts
from ..types import Frame
from .map_reports import MapReports
from .step_report import StepReport, psnr_db

STATES = ("stable_opaque", "stable_transparent", "unstable_opaque", "unstable_transparent")
"""Counts of a step that add up to its Gaussians, as in ``state_counts``."""


def manage_states(mapper: Any, frame: Frame) -> tuple[float, Transitions]:
    """Count errors of stable Gaussians, change states and remove outliers (section 3.2, "State
    management"). Returns the PSNR of the view before.

    Args:
        mapper: The ``RTGSLAM``.
        frame: The frame that was mapped.
    """
    model = mapper.gaussians
    config = mapper.config
    part = mapper.parts.boxes.rows(model.params, frame.camera, frame.T_WC)
    view = mapper.surface(frame.camera, frame.T_WC, frame.depth_m)
    if not runs_learners_code():
        mapper.transaction.keep()  # from here on the counts of any row change
    count_views(model, frame.camera, frame.T_WC, part)
    has_depth = frame.depth_m > 0
    colour_error = (view.rgb - frame.rgb).abs().mean(dim=-1) * has_depth
    depth_error_m = torch.where(
        has_depth & (view.depth_m > 0),
        frame.depth_m - view.depth_m,
        0.0,
    )
    count_errors(
        model,
        colour_error,
        view.dominant_index,
        depth_error_m,
        view.hit_index,
        config.states,
    )
    transitions = change_states(model, config.states, config.window.confidence_per_step)
    return psnr_db(view.rgb, frame.rgb), transitions


def n_stable(step: StepReport) -> int:
    """Number of stable Gaussians after a step."""
    return step.counts["stable_opaque"] + step.counts["stable_transparent"]


def state_shares(steps: Sequence[StepReport]) -> dict[str, float]:
    """Share of the Gaussians in each state, mean over the frames, and that of the stable ones after
    the last frame.

    Args:
        steps: Of a run, in order; those without any Gaussian do not count.

    Returns:
        "share_stable" and "share_unstable", "share_stable_transparent" and
        "share_unstable_transparent" among them, "share_transparent" and "share_stable_last", each
        0..1 of all Gaussians; empty without a Gaussian.
    """
    steps = [step for step in steps if step.n_gaussians]
    if not steps:
        return {}
    mean = {name: fmean(step.counts[name] / step.n_gaussians for step in steps) for name in STATES}
    return {
        "share_stable": mean["stable_opaque"] + mean["stable_transparent"],
        "share_stable_transparent": mean["stable_transparent"],
        "share_unstable": mean["unstable_opaque"] + mean["unstable_transparent"],
        "share_unstable_transparent": mean["unstable_transparent"],
        "share_transparent": mean["stable_transparent"] + mean["unstable_transparent"],
        "share_stable_last": n_stable(steps[-1]) / steps[-1].n_gaussians,
    }


def why_never_stable(steps: Sequence[StepReport], config: RtgSlamConfig, most_steps: int) -> str:
    """A sentence that says that no Gaussian has become stable, and what is missing; empty if one
    has.

    Args:
        steps: Of a run, in order.
        config: Its settings.
        most_steps: Largest number of steps that changed the colour of a Gaussian of the map.
    """
    if not steps or any(step.counts["stabilised"] or n_stable(step) for step in steps):
        return ""
    confidence = most_steps * config.window.confidence_per_step
    return (
        f"RTG-SLAM's stable state never occurred: in {len(steps)} frames no Gaussian reached a "
        f"confidence above states.stable_confidence {config.states.stable_confidence:g}, the "
        f"highest is {confidence:g}; so all were optimised all the time, and the paper's rule "
        "could seed no transparent one"
    )


class DiscReports(MapReports):
    """Reports that count states."""

    def counts(self) -> dict[str, int]:
        """Gaussians by state and kind."""
        counts = state_counts(self.mapper.gaussians)
        return {f"n_{name}": count for name, count in counts.items()}

    def run_metrics(self, steps: Sequence[StepReport]) -> dict[str, Any]:
        """Share of the Gaussians in each state."""
        return state_shares(steps)

    def run_notes(self, steps: Sequence[StepReport]) -> list[str]:
        """Whether no Gaussian has become stable."""
        gaussians = self.mapper.gaussians
        most_steps = int(gaussians.confidence.amax()) if len(gaussians) else 0
        sentence = why_never_stable(steps, self.mapper.config, most_steps)
        return [sentence] if sentence else []
