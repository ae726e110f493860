"""Stored poses: from another convention (direction, axes, order of numbers, unit) to ours, and
between their times."""

import contextlib
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...errors import BadFrameError, SequenceError
from ...geometry import quaternion, se3
from ..sequence import Sequence

_DIRECTION = {
    "right": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "down": (0.0, 1.0, 0.0),
    "up": (0.0, -1.0, 0.0),
    "forward": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
}
_ORDER = {"wxyz": [1, 2, 3, 0], "xyzw": [3, 0, 1, 2]}


def stored_poses(sequence: Sequence) -> Float[Tensor, "L 4 4"]:
    """Poses of all frames as the sequence gives them, float64; NaN where it raises
    ``BadFrameError``."""
    poses = torch.full(
        (len(sequence), 4, 4),
        torch.nan,
        dtype=torch.float64,
    )
    for i in range(len(sequence)):
        with contextlib.suppress(BadFrameError):
            poses[i] = sequence.pose(i).double()
    return poses


def reread_poses(stored: Float[Tensor, "N 4 4"], repair: RepairConfig) -> Float[Tensor, "N 4 4"]:
    """Camera-to-world poses, OpenCV axes, metres, from matrices stored in the convention of
    ``repair``.

    In this order: order of the 16 numbers, nearest rotation, order of the quaternion, direction,
    axes, unit of length. With the stored camera's axes, expressed in OpenCV's, as the columns of M,
    T_WC = T M^T; if the axes are mirrored (det M = -1), so is the world, and T_WC = M T M^T.

    Args:
        stored: Matrices as they were read. [N, 4, 4]
        repair: Which convention they follow.

    Differentiable: no.
    """
    T = raw_matrices(stored, repair)
    if repair.quaternions != "as_read":
        quat = quaternion.from_matrix(T[:, :3, :3])
        T = _with_rotation(T, quaternion.to_matrix(quat[:, _ORDER[repair.quaternions]]))
    if repair.poses == "world_to_camera":
        T = se3.inverse(T)
    elif repair.poses == "rotation_inverted":
        T = _with_rotation(T, T[:, :3, :3].transpose(1, 2))
    M = axis_matrix(repair).to(T.dtype)
    T = T @ M.T if torch.linalg.det(M) > 0 else M @ T @ M.T
    if repair.translation_factor != 1:
        T = T.clone()
        T[:, :3, 3] *= repair.translation_factor
    return T


def axis_matrix(repair: RepairConfig) -> Float[Tensor, "4 4"]:
    """M of ``reread_poses``: from the stored camera's axes to OpenCV's, float64.

    Transforms from camera to camera become M T M^T, whether M mirrors or not.
    """
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = torch.tensor(
        [_DIRECTION[word] for word in repair.axis_words], dtype=torch.float64
    ).T
    return M


def raw_matrices(stored: Float[Tensor, "N 4 4"], repair: RepairConfig) -> Float[Tensor, "N 4 4"]:
    """The corrections that make 16 numbers a rigid matrix: their order, and the nearest rotation
    (by SVD).

    Matrices with NaN are not changed. A scale factor common to rotation and bottom right entry is
    divided out.
    """
    T = stored.transpose(1, 2) if repair.matrices == "column_major" else stored
    if repair.nearest_rotation:
        T = T.clone()
        known = torch.isfinite(T).all(dim=(1, 2))
        U, _, V = torch.linalg.svd(T[known][:, :3, :3])
        mirrored = torch.linalg.det(U @ V) < 0
        U = U.clone()
        U[mirrored, :, 2] *= -1
        T[known, :3, :3] = U @ V
        T[known, 3] = T.new_tensor([0.0, 0.0, 0.0, 1.0])
    return T


def pose_between(
    T_a: Float[Tensor, "*B 4 4"], T_b: Float[Tensor, "*B 4 4"], t: float
) -> Float[Tensor, "*B 4 4"]:
    """The pose at ``t`` from 0 (``T_a``) to 1 (``T_b``): linear in position, spherical in
    orientation."""
    a = quaternion.from_matrix(T_a[..., :3, :3])
    b = quaternion.from_matrix(T_b[..., :3, :3])
    turned = quaternion.slerp(
        a,
        b,
        a.new_full(a.shape[:-1], t),
    )
    from_a = T_a[..., :3, 3]
    to_b = T_b[..., :3, 3]
    T = T_a.clone()
    T[..., :3, :3] = quaternion.to_matrix(turned)
    T[..., :3, 3] = from_a + t * (to_b - from_a)
    return T


def _with_rotation(
    T: Float[Tensor, "N 4 4"],
    R: Float[Tensor, "N 3 3"],
) -> Float[Tensor, "N 4 4"]:
    T = T.clone()
    T[:, :3, :3] = R
    return T


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
        known = torch.isfinite(poses).all(dim=(1, 2)) & torch.isfinite(times_s)
        known[1:] &= times_s[1:] > times_s[:-1].cummax(0).values
        self._times = times_s[known].double()
        self._poses = poses[known].double()
        steps = self._times.diff()
        self.step_s = float(steps.median()) if len(steps) else 0.0
        """Median time from one pose to the next, seconds; 0 with fewer than two poses."""
        far = (steps > _LONGEST_GAP * self.step_s).long()
        # poses of one piece have no gap between them
        self._piece = torch.cat([far.new_zeros(1), far.cumsum(0)])

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
        s = times_s - self._times[k]
        T_k = self._poses[k]
        near = torch.stack([k + o for o in _NEIGHBOURS], 1)
        known = (near >= 0) & (near <= last)
        near = near.clamp(0, last)
        known &= self._piece[near] == self._piece[k, None]
        at_s = self._times[near] - self._times[k, None]
        xi = torch.zeros(len(k), 6, dtype=torch.float64)
        for j in range(len(_NEIGHBOURS)):
            # Lagrange's polynomial: 1 at this neighbour, 0 at the others and at T_k
            share = s / at_s[:, j]
            for m in set(range(len(_NEIGHBOURS))) - {j}:
                factor = (s - at_s[:, m]) / (at_s[:, j] - at_s[:, m])
                share = share * factor.where(known[:, m], 1.0)
            share = share.where(known[:, j], 0.0)
            xi_j = se3.log(se3.inverse(T_k) @ self._poses[near[:, j]])
            xi += share[:, None] * xi_j
        T = T_k @ se3.exp(xi)
        close = torch.minimum(to_left, to_right) <= self.step_s
        return T.where(close[:, None, None], torch.nan)


def times_of(source: Any) -> Float[Tensor, " L"] | None:
    """The times of the frames of a sequence or of a part of one, seconds; None where it has
    none."""
    if hasattr(source, "positions"):
        times = times_of(source.source)
        return None if times is None else times[source.positions]
    try:
        times = getattr(source, "times_s", None)
    except SequenceError:
        return None
    if times is None:
        times = getattr(source, "timestamps_s", None)
    if times is None or getattr(source, "no_times", ""):
        return None
    return torch.as_tensor(times, dtype=torch.float64)
