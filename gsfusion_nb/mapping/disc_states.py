"""The states of RTG-SLAM's Gaussians over a run: the number and share of each, and why none has
become stable."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from ..config import RtgSlamConfig
from ..gaussians.surfels import state_counts
from .map_reports import MapReports
from .step_report import StepReport

STATES = ("stable_opaque", "stable_transparent", "unstable_opaque", "unstable_transparent")
"""Counts of a step that add up to its Gaussians, as in ``state_counts``."""


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
    filled = [step for step in steps if step.n_gaussians]
    if not filled:
        return {}
    mean = {name: fmean(step.counts[name] / step.n_gaussians for step in filled) for name in STATES}
    return {
        "share_stable": mean["stable_opaque"] + mean["stable_transparent"],
        "share_stable_transparent": mean["stable_transparent"],
        "share_unstable": mean["unstable_opaque"] + mean["unstable_transparent"],
        "share_unstable_transparent": mean["unstable_transparent"],
        "share_transparent": mean["stable_transparent"] + mean["unstable_transparent"],
        "share_stable_last": n_stable(filled[-1]) / filled[-1].n_gaussians,
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
