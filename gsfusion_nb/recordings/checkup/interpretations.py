"""What the numbers of a recording may mean: pose conventions and units of depth, scored by how well
frames agree."""

import itertools
import math
from collections import abc
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...config.repair import AXES, NAMED_AXES
from ...data.adjust.depth_agreement import depth_consistency, relative_poses, sparse_points
from ...data.adjust.poses import axis_matrix, reread_poses
from .sample import Sample

GAPS = (1, 2, 4, 8, 16, 30)
"""Distances in frames between the two of a pair: near frames overlap in any recording, far ones
show small errors."""

PAIRS_PER_GAP = 6

DEPTH_FACTORS = (
    0.2,
    5.0,
    0.1,
    10.0,
    0.01,
    100.0,
    0.001,
    1000.0,
    1000 / 6553.5,
    6.5535,
    5 / 6.5535,
    6.5535 / 5,
    0.25,
    4.0,
)
"""Ratios between the scales of public data sets, of metres, centimetres and millimetres, of 5000
and 6553.5, and of sensors that store quarter millimetres."""

PRICE = 0.01
"""Required gain in score for each change; of two that fit equally well the simpler interpretation
is chosen."""

_ROUGH_POINTS = 120

_FINE_POINTS = 800

_ROUGH_PAIRS = 10

_KEPT = 30

_POSES_AT_ONCE = 512


class ScoredInterpretation(NamedTuple):
    """An interpretation of the recording, and how well the depth images agree with it, as mean over
    the pairs."""

    repair: RepairConfig
    """Direction, axes and quaternion order of the poses, and a factor on depth."""
    score: float
    """0..1; see ``DepthConsistency.score``."""

    @property
    def worth(self) -> float:
        """Score minus the required gain of the changes."""
        return self.score - PRICE * len(self.repair.changes)


def pairs_of(sample: Sample) -> list[tuple[int, int]]:
    """Positions of the frames to compare: for each distance a few pairs, spread over the frames
    read."""
    pairs = []
    by_place = sample.by_place
    for gap in GAPS:
        firsts = [f.place for f in sample.frames if f.place + gap in by_place]
        if firsts:
            picks = (
                np.linspace(0, len(firsts) - 1, min(PAIRS_PER_GAP, len(firsts))).round().astype(int)
            )
            pairs += [(firsts[i], firsts[i] + gap) for i in sorted(set(picks.tolist()))]
    return pairs


def _scored(
    sample: Sample,
    pairs: abc.Sequence[tuple[int, int]],
    interpretations: abc.Sequence[RepairConfig],
    points: int,
) -> list[ScoredInterpretation]:
    """Score each interpretation on the pairs, with about ``points`` points of each; the best
    first."""
    by_place = sample.by_place
    camera = sample.depth_camera
    T_a = torch.stack([by_place[a].T_stored for a, _ in pairs])
    T_b = torch.stack([by_place[b].T_stored for _, b in pairs])
    relative = _relatives(T_a, T_b, interpretations)
    step = max(1, round(math.sqrt(camera.width * camera.height / points)))
    scores = []
    for i, (a, b) in enumerate(pairs):
        xyz_a = sparse_points(camera, by_place[a].depth_m, step)
        depth_b = by_place[b].depth_m
        parts = relative[:, i].split(_POSES_AT_ONCE)
        scores.append(
            torch.cat([depth_consistency(xyz_a, depth_b, camera, T_ba).score for T_ba in parts])
        )
    mean = torch.stack(scores).mean(0).tolist()
    return sorted(map(ScoredInterpretation, interpretations, mean), key=lambda t: -t.worth)


def best_interpretation(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]]
) -> list[ScoredInterpretation]:
    """Score all pose conventions with all depth scales on few points, and the best ones again on
    more; best first."""
    names = {words: name for name, words in NAMED_AXES.items()}
    interpretations = [
        RepairConfig(
            quaternions=q,
            poses=p,
            axes=names.get(words, words),
            depth_factor=f,
        )
        for q, p, words, f in itertools.product(
            ("as_read", "wxyz", "xyzw"),
            ("camera_to_world", "world_to_camera", "rotation_inverted"),
            AXES,
            (1.0, *DEPTH_FACTORS),
        )
    ]
    middle = [
        pairs[i]
        for i in sorted({int(i) for i in np.linspace(0, len(pairs) - 1, _ROUGH_PAIRS).round()})
    ]
    rough = _scored(sample, middle, interpretations, _ROUGH_POINTS)[:_KEPT]
    best_repairs = [t.repair for t in rough if t.repair.changes]
    return _scored(sample, pairs, [RepairConfig(), *best_repairs], _FINE_POINTS)


def _relatives(
    T_a: Float[Tensor, "P 4 4"],
    T_b: Float[Tensor, "P 4 4"],
    interpretations: abc.Sequence[RepairConfig],
) -> Float[Tensor, "K P 4 4"]:
    """Transforms from camera a to camera b under every interpretation, in units of the depth as
    read.

    A factor on depth scales all points and keeps directions, so the translation is divided by it
    instead. Interpretations that differ only in axes and depth factor share the rest.
    """
    relative_of: dict[tuple[str, str], Float[Tensor, "P 4 4"]] = {}
    axes: dict[str, Float[Tensor, "4 4"]] = {}
    for r in interpretations:
        if (r.quaternions, r.poses) not in relative_of:
            a, b = (reread_poses(T, replace(r, axes="opencv")) for T in (T_a, T_b))
            relative_of[r.quaternions, r.poses] = relative_poses(a, b)
        if r.axes not in axes:
            axes[r.axes] = axis_matrix(r)
    M = torch.stack([axes[r.axes] for r in interpretations])[:, None]
    relative = (
        M
        @ torch.stack([relative_of[r.quaternions, r.poses] for r in interpretations])
        @ M.transpose(2, 3)
    )
    factors = torch.tensor([r.depth_factor for r in interpretations], dtype=relative.dtype)
    relative[..., :3, 3] /= factors[:, None, None]
    return relative
