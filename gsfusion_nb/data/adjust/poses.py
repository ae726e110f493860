"""Stored poses: from another convention (direction, axes, order of numbers, unit) to ours,
and their times."""

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


def reread_poses(T_stored: Float[Tensor, "N 4 4"], repair: RepairConfig) -> Float[Tensor, "N 4 4"]:
    """Camera-to-world poses, OpenCV axes, metres, from matrices stored in the convention of
    ``repair``.

    In this order: order of the 16 numbers, nearest rotation, order of the quaternion, direction,
    axes, unit of length. With the stored camera's axes, expressed in OpenCV's, as the columns of M,
    T_WC = T M^T; if the axes are mirrored (det M = -1), so is the world, and T_WC = M T M^T.

    Args:
        T_stored: Matrices as they were read. [N, 4, 4]
        repair: Which convention they follow.

    Differentiable: no.
    """
    T = raw_matrices(T_stored, repair)
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


def raw_matrices(T_stored: Float[Tensor, "N 4 4"], repair: RepairConfig) -> Float[Tensor, "N 4 4"]:
    """The corrections that make 16 numbers a rigid matrix: their order, and the nearest rotation
    (by SVD).

    Matrices with NaN are not changed. A scale factor common to rotation and bottom right entry is
    divided out.
    """
    T = T_stored.transpose(1, 2) if repair.matrices == "column_major" else T_stored
    if repair.nearest_rotation:
        T = T.clone()
        is_finite = torch.isfinite(T).all(dim=(1, 2))
        U, _, V = torch.linalg.svd(T[is_finite][:, :3, :3])
        is_mirror = torch.linalg.det(U @ V) < 0
        U = U.clone()
        U[is_mirror, :, 2] *= -1
        T[is_finite, :3, :3] = U @ V
        T[is_finite, 3] = T.new_tensor([0.0, 0.0, 0.0, 1.0])
    return T


def _with_rotation(
    T: Float[Tensor, "N 4 4"],
    R: Float[Tensor, "N 3 3"],
) -> Float[Tensor, "N 4 4"]:
    T = T.clone()
    T[:, :3, :3] = R
    return T


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
