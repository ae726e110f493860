"""Poses that are improved in the passes after the scan: each keyframe moves towards the pose at which the map fits it.

A keyframe moves one step whenever it is visited, because the map's picture of it is there anyway. A prior holds each
pose at that of the data. After each pass, the mean motion of all keyframes is taken back, by moving map and
keyframes together, so that the map stays where the data puts it; and the frames between keyframes follow them.
"""

from math import radians

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import Keyframe, KeyframeList, pose_step, pose_system
from ..types import RenderOutput
from .localiser import Localiser

LEAST_SHARE = 0.5
"""A view moves only if the map shows at least this share of its pixels."""


class PoseRefinement:
    """What a mapper does to poses by ``optim.refine_poses``. The poses are the localiser's and the keyframes'."""

    def __init__(self, optim: OptimConfig, localiser: Localiser):
        self.enabled = optim.refine_poses
        sigma = [optim.pose_sigma_m] * 3 + [radians(optim.pose_sigma_deg)] * 3
        self._sigma = torch.tensor(sigma, dtype=torch.float64)
        self._localiser = localiser

    def move(
        self, keyframes: KeyframeList, keyframe: Keyframe, output: RenderOutput, target: Float[Tensor, "H W 3"]
    ) -> None:
        """Move a keyframe one step, by the map's picture of it that its last gradient was computed from."""
        row = self._localiser.frame_indices.index(keyframe.index)
        system = pose_system(output, target, keyframe.camera)
        if system.share >= LEAST_SHARE:
            T_WC = pose_step(system, keyframe.T_WC, self._localiser.given[row], self._sigma)
            keyframes.set_pose(keyframe.index, T_WC)
            self._localiser.refine(row, T_WC.cpu())

    def end_pass(self, keyframes: KeyframeList, gaussians: GaussianModel) -> None:
        """Take the keyframes' mean motion back, from them and from the map; let the other frames follow.

        Where all keyframes move together by G, T_i = G T_i(given), the pictures do not change and nothing holds G.
        """
        poses, given = self._localiser.poses, self._localiser.given
        rows = sorted(self._localiser.frame_indices.index(k.index) for k in keyframes)
        T_WC, T_given = (torch.stack([p[r] for r in rows]).double() for p in (poses, given))
        back = se3.exp(-se3.log(T_WC @ se3.inverse(T_given)).mean(0))
        gaussians.move(back.to(gaussians.device, torch.float32).expand(len(gaussians), 4, 4))
        for keyframe in list(keyframes):
            row = self._localiser.frame_indices.index(keyframe.index)
            T_new = (back @ poses[row].double()).float()
            keyframes.set_pose(keyframe.index, T_new)
            self._localiser.refine(row, T_new)
        self._localiser.follow(rows)
