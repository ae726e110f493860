"""Does a map that a run begins with lie in the frame of the recording's poses? Looked at from a few of its views."""

import torch

from ..data import Sequence, SequenceError
from ..mapping import Mapper
from ..types import Frame

VIEWS = 6
"""Views that are looked at, spread over the recording."""
_SEEN = 0.02
"""A view in which a smaller part of the pixels is covered does not see the map."""
_COVERED = 0.1
"""Depth is compared in views of which at least this part is covered."""
_FAR_OFF = 0.2
"""Largest usual median difference between rendered and measured depth, as a part of the measured one."""


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
