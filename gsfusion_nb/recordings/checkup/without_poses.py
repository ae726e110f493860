"""What can be said of a recording without poses: about its images, not about a path that nobody measured."""

import numpy as np
import torch

from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import Sequence
from ..convert.depth_unit import USUAL, plausible_range
from .findings import Finding
from .sample import Sample


def pose_finding() -> Finding:
    """Finding: there are no poses, so nothing that needs them is judged."""
    return Finding(
        name="poses",
        verdict="unknown",
        sentence=(
            "The recording has no poses. Their direction, axes, time and jumps, the intrinsics, and whether depth "
            "images agree, cannot be known; they are not judged here."
        ),
        repair="--tracking.poses tracked --reader poses=false",
    )


def unit_finding(sample: Sample, base: Sequence) -> Finding:
    """Finding: are the depths those of a hand-held camera in the unit as read?"""
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in sample.frames]).numpy()
    low, middle, high = (float(np.percentile(values, q)) if len(values) else float("nan") for q in (1, 50, 95))
    text = f"as read, depths are {low:.2f} to {high:.2f} m, median {middle:.2f} m"
    scale = base.depth_scale if isinstance(base, RecordedSequence) else 1.0
    stored = values * scale
    if plausible_range(scale, stored):
        return Finding(
            name="depth scale",
            verdict="unknown",
            numbers={"factor": 1.0},
            sentence=f"The unit of depth cannot be known without poses; {text}, which is plausible.",
        )
    others = [s for s in USUAL if s != scale and plausible_range(s, stored)]
    also = f"; with {others[0]:g} units a metre the median is {middle * scale / others[0]:.2f} m" if others else ""
    return Finding(
        name="depth scale",
        verdict="doubtful",
        numbers={"factor": scale / others[0] if others else 1.0},
        repair=f"--data.repair.depth-factor {scale / others[0]:g}"
        if others
        else "give the unit in which depth is stored",
        sentence=f"The unit of depth is not plausible for a hand-held camera: {text}{also}.",
    )
