"""All interpretations of poses and depth scale, and which of them the depth images confirm."""

import functools
import itertools
import math
from collections import abc
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...config.parts import AXES, NAMED_AXES
from ...data.adjust.depth_agreement import DepthConsistency, DepthPair, depth_consistency, depth_pair, relative_under
from ...data.adjust.poses import axis_matrix
from .sample import Sample

GAPS = (1, 2, 4, 8, 16, 30)
"""Distances in frames between the two of a pair: near frames overlap in any recording, far ones show small errors."""
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
"""Ratios between the scales of public data sets, of metres, centimetres and millimetres, of 5000 and 6553.5, and of
sensors that store quarter millimetres."""
PRICE = 0.01
"""Required gain in score for each change; of two that fit equally well the simpler interpretation is chosen."""

_ROUGH_POINTS, _FINE_POINTS = 120, 800
_ROUGH_PAIRS = 10
_KEPT = 30


Interpretation = tuple[RepairConfig, float]
"""An interpretation of the poses, and a factor on depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredInterpretation:
    """One interpretation and how well the depth images agree with it, as means over the pairs."""

    poses: RepairConfig
    """Direction, axes and quaternion order."""
    depth_factor: float
    score: float
    """0..1; see ``DepthConsistency.score``."""
    agreeing: float
    """Share of the points that agree within 3 per cent."""
    median_m: float
    """Median over the pairs of the median depth difference, metres."""

    @functools.cached_property
    def worth(self) -> float:
        """Score minus the required gain of the changes."""
        return self.score - PRICE * (len(self.poses.changes) + (self.depth_factor != 1.0))

    @property
    def is_as_read(self) -> bool:
        """Whether it changes nothing."""
        return self.depth_factor == 1.0 and not self.poses.changes

    @property
    def repair(self) -> RepairConfig:
        """The same as a correction."""
        return replace(self.poses, depth_factor=self.depth_factor)


def pairs_of(sample: Sample) -> list[tuple[int, int]]:
    """Positions of the frames to compare: for each distance a few pairs, spread over the frames read."""
    found = []
    there = sample.by_place
    for gap in GAPS:
        firsts = [f.place for f in sample.frames if f.place + gap in there]
        if firsts:
            chosen = np.linspace(0, len(firsts) - 1, min(PAIRS_PER_GAP, len(firsts))).round().astype(int)
            found += [(firsts[i], firsts[i] + gap) for i in sorted(set(chosen.tolist()))]
    return found


def depth_pairs(sample: Sample, pairs: abc.Sequence[tuple[int, int]], points: int) -> list[DepthPair]:
    """The pairs with about ``points`` points each."""
    step = max(1, round(math.sqrt(sample.depth_camera.width * sample.depth_camera.height / points)))
    there = sample.by_place
    return [
        depth_pair(there[a].depth_m, there[b].depth_m, sample.depth_camera, step=step, frames=(a, b)) for a, b in pairs
    ]


def try_interpretations(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]], interpretations: abc.Sequence[Interpretation], points: int
) -> list[ScoredInterpretation]:
    """Score each interpretation on the pairs; same order."""
    there = sample.by_place
    T_a = torch.stack([there[a].T_stored for a, _ in pairs])
    T_b = torch.stack([there[b].T_stored for _, b in pairs])
    relative = _relatives(T_a, T_b, interpretations)
    results = [_in_parts(pair, relative[:, i]) for i, pair in enumerate(depth_pairs(sample, pairs, points))]
    score, agreeing = (torch.stack([getattr(r, n) for r in results]).mean(0).tolist() for n in ("score", "agreeing"))
    median_m = torch.stack([r.median_m for r in results]).nanmedian(dim=0).values.tolist()
    return [
        ScoredInterpretation(
            poses=poses, depth_factor=factor, score=score[k], agreeing=agreeing[k], median_m=median_m[k] * factor
        )
        for k, (poses, factor) in enumerate(interpretations)
    ]


def best_interpretation(sample: Sample, pairs: abc.Sequence[tuple[int, int]]) -> list[ScoredInterpretation]:
    """Score all pose conventions with all depth scales on few points, and the best ones again on more; best first."""
    poses = [
        RepairConfig(quaternions=q, poses=p, axes=a)
        for q, p, a in itertools.product(
            ("as_read", "wxyz", "xyzw"), ("camera_to_world", "world_to_camera", "rotation_inverted"), _axes()
        )
    ]
    interpretations = [(r, f) for r in poses for f in (1.0, *DEPTH_FACTORS)]
    middle = [pairs[i] for i in sorted({int(i) for i in np.linspace(0, len(pairs) - 1, _ROUGH_PAIRS).round()})]
    rough = sorted(try_interpretations(sample, middle, interpretations, _ROUGH_POINTS), key=lambda t: -t.worth)
    kept = [(t.poses, t.depth_factor) for t in rough[:_KEPT] if not t.is_as_read]
    as_read = (RepairConfig(), 1.0)
    return sorted(try_interpretations(sample, pairs, [as_read, *kept], _FINE_POINTS), key=lambda t: -t.worth)


def _axes() -> list[str]:
    names = {words: name for name, words in NAMED_AXES.items()}
    return [names.get(words, words) for words in AXES]


def _relatives(
    T_a: Float[Tensor, "P 4 4"], T_b: Float[Tensor, "P 4 4"], interpretations: abc.Sequence[Interpretation]
) -> Float[Tensor, "K P 4 4"]:
    """Relative poses under every interpretation; those that differ only in axes and depth factor are computed once."""
    known: dict[tuple[str, str], Float[Tensor, "P 4 4"]] = {}
    axes: dict[str, Float[Tensor, "4 4"]] = {}
    for poses, _ in interpretations:
        key = (poses.quaternions, poses.poses)
        if key not in known:
            known[key] = relative_under(T_a, T_b, replace(poses, axes="opencv"))
        if poses.axes not in axes:
            axes[poses.axes] = axis_matrix(poses)
    M = torch.stack([axes[poses.axes] for poses, _ in interpretations])[:, None]
    relative = M @ torch.stack([known[(p.quaternions, p.poses)] for p, _ in interpretations]) @ M.transpose(2, 3)
    relative[..., :3, 3] /= torch.tensor([f for _, f in interpretations], dtype=relative.dtype)[:, None, None]
    return relative


def _in_parts(pair: DepthPair, T_ba: Float[Tensor, "K 4 4"], part: int = 512) -> DepthConsistency:
    """``depth_consistency`` in parts of ``part`` poses, which keeps the arrays small."""
    parts = [depth_consistency(pair, T_ba[k : k + part]) for k in range(0, len(T_ba), part)]
    names = ("agreeing", "overlap", "median_m", "score")
    return DepthConsistency(**{n: torch.cat([getattr(p, n) for p in parts]) for n in names})
