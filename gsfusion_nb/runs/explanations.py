"""Sentences that explain why a run has no map, or ended early."""

import contextlib

from ..data import SequenceError
from ..mapping import Mapper
from ..seeding import rule_name
from .mapping_run import MappingRun


def why_empty(run: MappingRun) -> str:
    """A sentence that explains why the map has no Gaussians after at least one frame."""
    n_seeds = sum(step.n_seeds for step in run.steps)
    rule = rule_name(run.mapper.rule)
    if n_seeds:
        why = (
            f"all {n_seeds:,} that were created were removed again (see the settings under states)"
        )
        return f"the map has no Gaussians: {why}"
    text = (
        f"the map has no Gaussians: the seeding rule {rule!r} proposed none for any of the "
        f"{len(run.steps)} frames"
    )
    with contextlib.suppress(SequenceError, StopIteration):
        frame = next(iter(run.views.sample(1)))
        depth_values = frame.depth_m[frame.depth_m > 0]
        low, high = (
            (float(depth_values.min()), float(depth_values.max()))
            if len(depth_values)
            else (0.0, 0.0)
        )
        text += f"; the depth of frame {frame.index} is from {low:.4g} to {high:.4g} m"
    return f"{text}; the rule's options are {run.mapper.config.seeding.options or 'the defaults'}"


def describe_full(mapper: Mapper) -> str:
    """A sentence that says what fills the memory, and which settings need less."""
    less = ["smaller images (data.width)", *mapper.description.memory_savers]
    if mapper.config.keyframes_on == "device":
        less.append("keyframes in CPU memory (keyframes_on = 'cpu')")
    return f"the memory of {mapper.device} is full of {mapper!r}; try {', '.join(less)}"
