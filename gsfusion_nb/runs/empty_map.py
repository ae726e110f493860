"""Explain why a run ended without Gaussians."""

from ..errors import SequenceError
from ..seeding import rule_name
from .mapping_run import MappingRun


def why_empty(run: MappingRun) -> str:
    """A sentence that explains why the map has no Gaussians after at least one frame."""
    n_seeds, n = sum(step.n_seeds for step in run.steps), len(run.steps)
    if n_seeds:
        created = f"all {n_seeds:,} that were created were removed again"
        return f"the map has no Gaussians: {created} (see the settings under states)"
    return f"the map has no Gaussians: {_without_seeds(run, n)}"


def _without_seeds(run: MappingRun, n: int) -> str:
    rule = f"the seeding rule {rule_name(run.mapper.rule)!r} proposed none for any of the {n} frames"
    try:
        frame = next(iter(run.mapped_views(1)))
    except (SequenceError, StopIteration):
        return rule
    known, near_m = frame.depth_m[frame.depth_m > 0], run.mapper.seed_context(frame.to(run.mapper.device)).near_m
    if not len(known):
        return f"frame {frame.index} has no depth at all, and {rule}"
    low, median, high = (float(x) for x in (known.min(), known.median(), known.max()))
    where = f"the depth of frame {frame.index} is from {low:.4g} to {high:.4g} m (median {median:.4g} m)"
    if high < (near_m or 0.0):
        return f"{where}, but only depth of at least {near_m:g} m is used; check the depth scale"
    options = run.mapper.config.seeding.options
    return f"{rule}; {where}; the rule's options are {options or 'the defaults'}"
