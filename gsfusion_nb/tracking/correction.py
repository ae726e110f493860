"""The correction after a loop closure: poses of keyframes before and after, and how everything else moves with them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import quaternion, se3


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """New poses of all keyframes. Gaussians and frames near a keyframe move with it."""

    frame_index: Int[Tensor, " K"]
    """Frame index of each keyframe, increasing."""
    T_WC_old: Float[Tensor, "K 4 4"]
    T_WC_new: Float[Tensor, "K 4 4"]
    """Camera-to-world, float64."""
    loops: list[tuple[int, int, int]]
    """(frame index, earlier frame index, matches that agree) of the loops found since the last correction."""
    error_before: float
    error_after: float
    """Half the sum of robust squared errors of the graph, in standard deviations."""

    def transform_of(self, frame_index: Int[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
        """The motion of the world near each frame: T_new T_old^-1, blended between the keyframes before and after.

        Args:
            frame_index: Frames, in any order. [N]

        Returns:
            World-to-world transforms, float64. Exactly the identity where the keyframes did not move.
        """
        return blend(self.frame_index, self.T_WC_old, self.T_WC_new, frame_index)


def blend(
    keyframe: Int[Tensor, " K"],
    T_old: Float[Tensor, "K 4 4"],
    T_new: Float[Tensor, "K 4 4"],
    frame_index: Int[Tensor, " N"],
    T_old_next: Float[Tensor, "K 4 4"] | None = None,
) -> Float[Tensor, "N 4 4"]:
    """T_new T_old^-1 at any frame, from its neighbouring keyframes.

    Rotations are interpolated along the shorter arc. The point c between the two old camera centres moves to the
    interpolation of its two images: R(t) = slerp(R_a, R_b, t), R(t) c + t(t) = (1 - t) D_a c + t D_b c.

    Args:
        keyframe: Frame index of the keyframes, increasing.
        T_old: Their poses before. [K, 4, 4]
        T_new: Their poses after. [K, 4, 4]
        frame_index: The frames; before the first and after the last keyframe its transform is used. [N]
        T_old_next: Poses before, for the frames that precede a keyframe, if they differ from ``T_old``. [K, 4, 4]
    """
    if len(keyframe) == 0:
        return torch.eye(4, dtype=torch.float64).expand(len(frame_index), 4, 4).clone()
    before = torch.searchsorted(keyframe, frame_index.to(keyframe), right=True) - 1
    a, b = before.clamp_min(0), (before + 1).clamp_max(len(keyframe) - 1)
    a = torch.where(before < 0, b.clamp_max(0), a)
    b = torch.where(before < 0, a, b)
    gap = (keyframe[b] - keyframe[a]).clamp_min(1)
    t = ((frame_index.to(keyframe) - keyframe[a]).double() / gap).clamp(0, 1) * (a != b)
    next_old = T_old if T_old_next is None else T_old_next
    D_a, D_b = _motion(T_old, T_new)[a], _motion(next_old, T_new)[b]
    R = quaternion.to_matrix(
        quaternion.slerp(quaternion.from_matrix(D_a[:, :3, :3]), quaternion.from_matrix(D_b[:, :3, :3]), t)
    )
    s = t[:, None]
    c = (1 - s) * T_old[a, :3, 3] + s * next_old[b, :3, 3]
    moved = (1 - s) * _apply(D_a, c) + s * _apply(D_b, c)
    D = torch.eye(4, dtype=torch.float64).expand(len(a), 4, 4).clone()
    D[:, :3, :3] = R
    D[:, :3, 3] = moved - (R @ c[:, :, None])[:, :, 0]
    D = torch.where((t == 0)[:, None, None], D_a, D)
    return torch.where(((D_a == D_b).flatten(1).all(1))[:, None, None], D_a, D)


def _motion(T_old: Tensor, T_new: Tensor) -> Tensor:
    """T_new T_old^-1; exactly the identity where they are equal."""
    same = (T_old == T_new).flatten(1).all(1)
    eye = torch.eye(4, dtype=torch.float64).expand_as(T_old)
    return torch.where(same[:, None, None], eye, T_new @ se3.inverse(T_old))


def _apply(T: Tensor, xyz: Tensor) -> Tensor:
    return (T[:, :3, :3] @ xyz[:, :, None])[:, :, 0] + T[:, :3, 3]
