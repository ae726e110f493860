"""The correction of a trajectory, and the motion of the world near each frame that follows."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import se3
from ..geometry.pose_path import pose_between


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """New poses of all keyframes. Gaussians and frames near a keyframe move with it."""

    frame_index: Int[Tensor, " K"]
    """Frame index of each keyframe, increasing."""
    T_WC_old: Float[Tensor, "K 4 4"]
    T_WC_new: Float[Tensor, "K 4 4"]
    """Camera-to-world, float64."""
    loops: list[tuple[int, int, int]]
    """(frame index, earlier frame index, matches that agree) of the loops found since the last
    correction."""

    def transform_of(self, frame_index: Int[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
        """The motion of the world near each frame: T_new T_old^-1, blended between the keyframes
        before and after.

        The point between the two old camera centres moves to the interpolation of its two images
        (``pose_between``, with this point as the pivot).

        Args:
            frame_index: Frames, in any order; before the first and after the last keyframe its
                transform is used. [N]

        Returns:
            World-to-world transforms, float64. Exactly the identity where the keyframes did not
            move.
        """
        keyframe = self.frame_index
        row = torch.searchsorted(keyframe, frame_index.to(keyframe), right=True) - 1
        a = row.clamp_min(0)
        b = (row + 1).clamp_max(len(keyframe) - 1)
        a = torch.where(row < 0, b.clamp_max(0), a)
        b = torch.where(row < 0, a, b)
        gap = (keyframe[b] - keyframe[a]).clamp_min(1)
        n_passed = (frame_index.to(keyframe) - keyframe[a]).double()
        t = (n_passed / gap).clamp(0, 1) * (a != b)
        motion = _motion(self.T_WC_old, self.T_WC_new)
        old_centre = self.T_WC_old[:, :3, 3]
        s = t[:, None]
        pivot = (1 - s) * old_centre[a] + s * old_centre[b]
        return pose_between(motion[a], motion[b], t, pivot=pivot)


def _motion(T_old: Tensor, T_new: Tensor) -> Tensor:
    """T_new T_old^-1; exactly the identity where they are equal."""
    same = (T_old == T_new).flatten(1).all(1)
    eye = torch.eye(4, dtype=torch.float64).expand_as(T_old)
    return torch.where(
        same[:, None, None],
        eye,
        T_new @ se3.inverse(T_old),
    )
