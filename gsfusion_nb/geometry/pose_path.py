"""Poses between given ones: between two, at a time of a list, and on a smooth path.

Between two poses the rotation turns along the shorter arc at a constant rate, and one point, the
pivot, moves along a straight line (``pose_between``); everything that interpolates poses linearly
calls it. A hand-held camera also speeds up and slows down between two frames: ``PosePath`` follows
that with a cubic.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from . import quaternion, se3


def pose_between(
    T_a: Float[Tensor, "*B 4 4"],
    T_b: Float[Tensor, "*B 4 4"],
    t: Float[Tensor, "*B"] | float,
    *,
    pivot: Float[Tensor, "*B 3"] | None = None,
) -> Float[Tensor, "*B 4 4"]:
    """The transform at ``t`` from 0 (``T_a``) to 1 (``T_b``).

        R(t) = slerp(R_a, R_b, t),     R(t) p + x(t) = (1 - t) T_a p + t T_b p

    with the pivot p, a point before the transform. Of a camera-to-world pose that is the camera's
    centre, p = 0: linear in position, spherical in orientation. Exactly ``T_a`` where t = 0, and
    where the two are equal.

    Args:
        T_a, T_b: Rigid transforms. [*B, 4, 4]
        t: Share of the way, 0..1; one for all, or one of each. [*B]
        pivot: The point that moves along a straight line; None: the origin. [*B, 3]

    Differentiable: no.
    """
    quat_a = quaternion.from_matrix(T_a[..., :3, :3])
    quat_b = quaternion.from_matrix(T_b[..., :3, :3])
    share = torch.as_tensor(t, dtype=T_a.dtype, device=T_a.device).expand(T_a.shape[:-2])
    R = quaternion.to_matrix(quaternion.slerp(quat_a, quat_b, share))
    p = torch.zeros_like(T_a[..., :3, 3:]) if pivot is None else pivot[..., None]
    image_a = T_a[..., :3, :3] @ p + T_a[..., :3, 3:]
    image_b = T_b[..., :3, :3] @ p + T_b[..., :3, 3:]
    image = image_a + share[..., None, None] * (image_b - image_a)
    T = T_a.clone()
    T[..., :3, :3] = R
    T[..., :3, 3:] = image - R @ p
    is_exact = (share == 0) | (T_a == T_b).all(-1).all(-1)
    return torch.where(is_exact[..., None, None], T_a, T)


def pose_at(
    times_s: Float[Tensor, " N"],
    poses: Float[Tensor, "N 4 4"],
    time_s: float,
    *,
    max_gap_s: float,
) -> Float[Tensor, "4 4"] | None:
    """The pose at a time, between the two around it (``pose_between``).

    Args:
        times_s: Increasing times, seconds. [N]
        poses: Rigid transforms at those times. [N, 4, 4]
        time_s: When the pose is asked for, seconds.
        max_gap_s: Largest time between the two surrounding poses, seconds.

    Returns:
        The pose, or None where it is unknown: outside the recorded time, or in a gap longer than
        ``max_gap_s``.
    """
    right = int(torch.searchsorted(times_s, time_s))
    if right < len(times_s) and float(times_s[right]) == time_s:
        return poses[right]
    if right in (0, len(times_s)):
        return None
    left_s = float(times_s[right - 1])
    gap_s = float(times_s[right]) - left_s
    if gap_s > max_gap_s:
        return None
    return pose_between(poses[right - 1], poses[right], (time_s - left_s) / gap_s)


_NEIGHBOURS = (-1, 1, 2)
_LONGEST_GAP = 4.0
"""A neighbour farther away than this many median steps does not say how the camera moved."""


class PosePath:
    """Poses at any time, interpolated on SE(3).

    Between the poses T_k and T_k+1 the path is T_k exp(xi(s)), where xi is the cubic in the time s
    since T_k that also goes through T_k+1, the pose before and the one after: a parabola makes a
    tremor of 5 Hz at 30 frames a second a sixth too slow, and two parabolas do not meet. At the
    ends of the recording, and beside a gap, through fewer.

    Args:
        times_s: Increasing times. [L]
        poses: Camera-to-world, float64; NaN where there is none. [L, 4, 4]
    """

    def __init__(self, times_s: Float[Tensor, " L"], poses: Float[Tensor, "L 4 4"]):
        is_known = torch.isfinite(poses).all(dim=(1, 2)) & torch.isfinite(times_s)
        is_known[1:] &= times_s[1:] > times_s[:-1].cummax(0).values
        self._times = times_s[is_known].double()
        self._poses = poses[is_known].double()
        steps = self._times.diff()
        self.step_s = float(steps.median()) if len(steps) else 0.0
        """Median time from one pose to the next, seconds; 0 with fewer than two poses."""
        is_gap = (steps > _LONGEST_GAP * self.step_s).long()
        # poses of one piece have no gap between them
        self._piece = torch.cat([is_gap.new_zeros(1), is_gap.cumsum(0)])

    def at(self, times_s: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
        """Camera-to-world poses; NaN farther than one median step from every pose. [N, 4, 4]"""
        if not len(self._times):
            return times_s.new_full((len(times_s), 4, 4), torch.nan)
        last = len(self._times) - 1
        right = torch.searchsorted(self._times, times_s).clamp(max=last)
        left = (right - 1).clamp_min(0)
        to_left = (times_s - self._times[left]).abs()
        to_right = (times_s - self._times[right]).abs()
        in_gap = self._piece[left] != self._piece[right]
        k = right.where(in_gap & (to_right < to_left), left)
        T = self._poses[k] @ se3.exp(self._twist(k, times_s))
        has_pose = torch.minimum(to_left, to_right) <= self.step_s
        return T.where(has_pose[:, None, None], torch.nan)

    def _twist(self, k: Int[Tensor, " N"], times_s: Float[Tensor, " N"]) -> Float[Tensor, "N 6"]:
        """xi: the motion since T_k, by Lagrange's polynomial through its neighbours."""
        s = times_s - self._times[k]
        neighbours = torch.stack([k + offset for offset in _NEIGHBOURS], 1)
        exists = (neighbours >= 0) & (neighbours < len(self._times))
        neighbours = neighbours.clamp(0, len(self._times) - 1)
        exists &= self._piece[neighbours] == self._piece[k, None]
        at_s = self._times[neighbours] - self._times[k, None]
        xi = torch.zeros(len(k), 6, dtype=torch.float64)
        for j in range(len(_NEIGHBOURS)):
            # 1 at this neighbour, 0 at the others and at T_k
            share = s / at_s[:, j]
            for m in set(range(len(_NEIGHBOURS))) - {j}:
                factor = (s - at_s[:, m]) / (at_s[:, j] - at_s[:, m])
                share = share * factor.where(exists[:, m], 1.0)
            share = share.where(exists[:, j], 0.0)
            xi += share[:, None] * se3.log(
                se3.inverse(self._poses[k]) @ self._poses[neighbours[:, j]]
            )
        return xi
