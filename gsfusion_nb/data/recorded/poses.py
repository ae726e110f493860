"""Camera poses from text: one matrix per line or file, checked rigid, and interpolation in time."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose
from ...foreign import read_text
from ...geometry import quaternion
from ...operands import check_place
from ..sequence import BadFrameError, SequenceError

MAX_RIGIDITY_ERROR = 1e-3
"""Largest entry of R R^T - I that still counts as a rotation: poses printed with 4 decimals pass."""


def read_rows(path: Path, columns: int, what: str) -> Float[Tensor, "N C"]:
    """Numbers of a text file, one row per line; empty lines and lines starting with ``#`` are skipped. float64. [N, C]

    NaN and infinities are kept: they mark a pose as lost.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no rows, a row of another length, or text that is not a
            number.
    """
    rows = []
    for number, words in read_words(path, what):
        if len(words) != columns:
            raise SequenceError(f"{path} line {number} must hold {columns} numbers ({what}), got {len(words)}")
        try:
            rows.append([float(w) for w in words])
        except ValueError:
            raise SequenceError(f"{path} line {number} must hold {columns} numbers ({what}), got text") from None
    return torch.tensor(rows, dtype=torch.float64)


def read_words(path: Path, what: str) -> list[tuple[int, list[str]]]:
    """Line number and words of every line that is neither empty nor a ``#`` comment. At least one, or an error."""
    text = read_text(path, what)
    lines = [(n, line.replace(",", " ").split()) for n, line in enumerate(text.splitlines(), 1)]
    lines = [(n, words) for n, words in lines if words and not words[0].startswith("#")]
    if not lines:
        raise SequenceError(f"{path} is empty; expected {what}")
    return lines


def read_pose_lines(path: Path) -> Float[Tensor, "N 4 4"]:
    """Poses written as 16 row-major numbers per line. float64, not yet checked. [N, 4, 4]"""
    return read_rows(path, 16, "16 row-major numbers of a camera-to-world pose per line").reshape(-1, 4, 4)


def write_pose_lines(path: Path, T_WC: Float[Tensor, "N 4 4"]) -> None:
    """Write ``poses.txt`` or ``traj.txt``: 16 row-major numbers per line."""
    lines = (" ".join(f"{value:.9g}" for value in pose) for pose in T_WC.double().flatten(1).tolist())
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def checked_pose(T_WC: Float[Tensor, "4 4"], source: str) -> Float[Tensor, "4 4"]:
    """``T_WC`` as float32 if it is a rigid transform.

    Raises:
        BadFrameError: NaN, infinite (ScanNet marks lost tracking with -inf), not rigid, or too far away to be mapped;
            names ``source``.
    """
    if not bool(torch.isfinite(T_WC).all()):
        raise BadFrameError(
            f"{source} has NaN or infinite entries; expected a camera-to-world pose (tracking was lost?)"
        )
    try:
        check_pose("the pose", T_WC, MAX_RIGIDITY_ERROR)
    except ValueError as e:
        raise BadFrameError(f"{source} is not a rigid camera-to-world pose: {e}") from None
    try:
        check_place(source, T_WC)
    except ValueError as e:
        raise BadFrameError(str(e)) from None
    return T_WC.to(torch.float32)


def read_stamped_poses(path: Path) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]:
    """Times, and rows ``tx ty tz qx qy qz qw`` with unit quaternions, in order of time. float64. [N], [N, 7]

    Rows with NaN or infinities are left out: there is no pose at that time.

    Raises:
        SequenceError: a row that is not 8 numbers, a quaternion whose length is not 1 within 1e-2, or two different
            poses at one time.
    """
    table = read_rows(path, 8, "timestamp tx ty tz qx qy qz qw")
    table = table[torch.isfinite(table).all(dim=1)]
    length = table[:, 4:].norm(dim=1)
    bad = ((length - 1).abs() > 1e-2).nonzero()
    if len(bad):
        t, wrong = float(table[int(bad[0]), 0]), float(length[int(bad[0])])
        raise SequenceError(
            f"{path}: the pose at {t:.6f} s must end in a unit quaternion, got one of length {wrong:.3g}"
        )
    table = table[table[:, 0].argsort(stable=True)]
    again = table[1:, 0] == table[:-1, 0]
    differs = again & (table[1:] != table[:-1]).any(dim=1)
    if bool(differs.any()):
        t = float(table[1:, 0][differs][0])
        raise SequenceError(f"{path} has two different poses at {t:.6f} s; expected every time once")
    table = table[torch.cat([~again.new_zeros(1), ~again])] if len(table) else table
    return table[:, 0].contiguous(), table[:, 1:]


def matrices(rows: Float[Tensor, "N 7"]) -> Float[Tensor, "N 4 4"]:
    """Matrices of rows ``tx ty tz qx qy qz qw``. [N, 4, 4]"""
    T = torch.eye(4, dtype=rows.dtype).repeat(len(rows), 1, 1)
    T[:, :3, :3] = quaternion.to_matrix(rows[:, [6, 3, 4, 5]])
    T[:, :3, 3] = rows[:, :3]
    return T


def interpolate_rows(
    stamps_s: Float[Tensor, " N"], rows: Float[Tensor, "N 7"], at_s: float, *, max_gap_s: float
) -> Float[Tensor, " 7"] | None:
    """Pose ``tx ty tz qx qy qz qw`` at time ``at_s``: linear in position, spherical in orientation.

    Args:
        stamps_s: Increasing times, seconds. [N]
        rows: Poses at those times. [N, 7]
        at_s: Time wanted, seconds.
        max_gap_s: Largest time between the two surrounding poses, seconds.

    Returns:
        The pose, or None where it is unknown: outside the recorded time, or in a gap longer than ``max_gap_s``.
    """
    after = int(torch.searchsorted(stamps_s, at_s))
    if after < len(stamps_s) and float(stamps_s[after]) == at_s:
        return rows[after]
    if after in (0, len(stamps_s)):
        return None
    gap = float(stamps_s[after] - stamps_s[after - 1])
    if gap > max_gap_s:
        return None
    t = torch.tensor((at_s - float(stamps_s[after - 1])) / gap, dtype=rows.dtype)
    a, b = rows[after - 1], rows[after]
    quat = quaternion.slerp(a[[6, 3, 4, 5]], b[[6, 3, 4, 5]], t)
    return torch.cat([a[:3] + t * (b[:3] - a[:3]), quat[[1, 2, 3, 0]]])


def no_poses(n: int) -> Float[Tensor, "n 4 4"]:
    """Identities, for a recording that came without poses; float64."""
    return torch.eye(4, dtype=torch.float64).expand(n, 4, 4).clone()
