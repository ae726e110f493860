"""What a run warns about: a map in another frame, a small disk, a map without Gaussians, full memory."""

import logging
from pathlib import Path

import torch

from ..data import Sequence, SequenceError
from ..files import free_space
from ..mapping import Mapper
from ..seeding import rule_name
from ..types import Frame
from .mapping_run import MappingRun

log = logging.getLogger(__name__)

VIEWS = 6
"""Views that are looked at, spread over the recording."""
_SEEN = 0.02
"""A view in which a smaller part of the pixels is covered does not see the map."""
_COVERED = 0.1
"""Depth is compared in views of which at least this part is covered."""
_FAR_OFF = 0.2
"""Largest usual median difference between rendered and measured depth, as a part of the measured one."""
_BASE_BYTES = 50_000_000
_BYTES_PER_PIXEL = 16
"""Bytes that a frame adds per pixel to maps and checkpoints, averaged over runs of 200 frames."""


@torch.no_grad()
def doubts_about_frame(mapper: Mapper, frames: Sequence, name: str) -> list[str]:
    """A warning if no view sees the Gaussians of ``mapper``, or if their depth is far off in all views.

    The best of the views counts: a map may show only a part of what the recording sees.

    Args:
        mapper: With Gaussians, before the first frame.
        frames: With poses.
        name: Of the file of the Gaussians.
    """
    n = len(frames)
    seen, differences = 0.0, []
    for i in sorted({round(k * (n - 1) / (VIEWS - 1)) for k in range(VIEWS)}):
        try:
            covered, difference = _compared(mapper, frames[i])
        except SequenceError:  # a frame that cannot be read; the run says so
            continue
        seen = max(seen, covered)
        if covered >= _COVERED and difference is not None:
            differences.append(difference)
    asked = "is it in the world frame of the recording's poses, in metres? A file that was turned for viewers is not"
    if seen < _SEEN:
        return [f"none of {min(VIEWS, n)} views of the recording sees the Gaussians of {name}: {asked}"]
    if differences and min(differences) > _FAR_OFF:
        return [
            f"the depth of the Gaussians of {name} differs from the measured depth by {100 * min(differences):.0f} % "
            f"or more (median of a view) in all {len(differences)} views that see them: {asked}"
        ]
    return []


def _compared(mapper: Mapper, frame: Frame) -> tuple[float, float | None]:
    """The covered part of a view, and the median relative difference of depth where both are known."""
    frame = frame.to(mapper.device)
    out = mapper.render(frame.camera, frame.T_WC)
    covered = out.alpha > 0.5
    both = covered & (frame.depth_m > 0)
    if not bool(both.any()):
        return float(covered.float().mean()), None
    depth_m = out.depth_m[both] / out.alpha[both]
    return float(covered.float().mean()), float(((depth_m / frame.depth_m[both]) - 1).abs().median())


def estimated_bytes(run: MappingRun) -> int:
    """Rough estimate of how much a run writes, including checkpoints; half or twice as much is usual."""
    camera, frames = run.sequence.camera, len(run.sequence.mapping)
    return _BASE_BYTES + _BYTES_PER_PIXEL * camera.width * camera.height * frames


def warn_of_little_space(run: MappingRun, folder: Path) -> None:
    """Add a warning to the run if the free disk space is less than it may need."""
    need, free = estimated_bytes(run), free_space(folder)
    if free < need:
        sentence = f"only {free / 1e6:.0f} MB are free in {folder}, and this run may need about {need / 1e6:.0f} MB"
        run.warnings.append(sentence)
        log.warning(sentence)


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


def describe_full(mapper: Mapper) -> str:
    """A sentence that says what fills the memory, and which settings need less."""
    holds = [f"{part.count:,} {part.name} ({part.size_bytes / 1e6:.0f} MB)" for part in mapper.parts()]
    less = ["smaller images (data.width)", *mapper.memory_savers]
    if mapper.config.keyframes_on == "device":
        less.append("keyframes in CPU memory (keyframes_on = 'cpu')")
    return f"the memory of {mapper.device} is full: it holds {', '.join(holds)}; try {', '.join(less)}"
