"""Which unit of depth agrees with the poses: points of one depth image, moved into another one."""

from collections import abc
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...data.adjust.depth_agreement import depth_consistency, depth_pair, relative_poses
from ...data.sequence import BadFrameError
from ...geometry import se3
from ...types import Camera
from .image_files import read_depth_file

SCALES = (0.0, 1.0, 256.0, 1000.0, 4000.0, 5000.0, 6553.5, 10000.0)
"""Units a metre that are tried. 0 leaves the camera's motion out: a unit that is right must do better than that."""
_PAIRS = 6
_REACH = 60
"""Frames between the two of a pair, at most."""
_MOVED_M = 0.1
"""Motion that tells one unit from another."""


def fits_poses(
    files: abc.Sequence[Path], poses: abc.Sequence[Float[Tensor, "4 4"] | None], camera: Camera
) -> dict[float, float]:
    """Units a metre -> share of the points, weighted by how well they agree, over a few pairs of frames.

    Empty where no pair of frames with poses and depth moved by 10 cm. Distortion is ignored.

    Args:
        files: Depth images in order.
        poses: Camera-to-world pose of each, metres; None where it is unknown.
        camera: Camera of the depth images.
    """
    scores = []
    for first in sorted({int(i) for i in np.linspace(0, max(len(files) - 2, 0), _PAIRS)}):
        second = _partner(poses, first)
        T_a, T_b = poses[first], poses[second] if second else None
        if T_a is None or T_b is None:
            continue
        try:
            depth_a, depth_b = (torch.from_numpy(read_depth_file(files[i], 1.0)) for i in (first, second))
        except BadFrameError:
            continue
        fitted = camera.resized(depth_a.shape[1], depth_a.shape[0])
        T_ba = relative_poses(T_a.double()[None], T_b.double()[None]).expand(len(SCALES), 4, 4).clone()
        T_ba[:, :3, 3] *= torch.tensor(SCALES, dtype=torch.float64)[:, None]
        scores.append(depth_consistency(depth_pair(depth_a, depth_b, fitted, step=8), T_ba).score)
    return dict(zip(SCALES, torch.stack(scores).mean(0).tolist(), strict=True)) if scores else {}


def some_depths(files: abc.Sequence[Path], n: int = 8) -> list[np.ndarray]:
    """A few depth images as stored, spread over the recording; damaged ones are left out."""
    found = []
    for i in sorted({int(i) for i in np.linspace(0, len(files) - 1, n)}):
        try:
            found.append(read_depth_file(files[i], 1.0))
        except BadFrameError:
            continue
    return found


def _partner(poses: abc.Sequence[Float[Tensor, "4 4"] | None], first: int) -> int:
    """The next frame that moved far enough; 0 if there is none."""
    T = poses[first]
    for i in range(first + 1, min(first + 1 + _REACH, len(poses))):
        other = poses[i]
        if T is not None and other is not None:
            relative = se3.inverse(T.double()) @ other.double()
            if float(relative[:3, 3].norm()) >= _MOVED_M:
                return i
    return 0
