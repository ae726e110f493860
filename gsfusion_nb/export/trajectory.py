"""Trajectories in the text format of the TUM RGB-D benchmark: ``t tx ty tz qx qy qz qw``, seconds,
metres, camera-to-world."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import shown
from ..errors import ArgumentError
from ..files import read_text, write_file
from ..geometry import quaternion


def write_trajectory_tum(
    path: str | Path, timestamps_s: Sequence[float], poses: Float[Tensor, "N 4 4"]
) -> None:
    """Write camera-to-world poses, atomically, with 9 decimals (nanometres, nanoseconds). ``evo``
    reads the file.

    Args:
        path: File to write.
        timestamps_s: Time of each pose, seconds. Python floats: float32 cannot hold a Unix time.
            [N]
        poses: Camera-to-world, OpenCV axes, metres. [N, 4, 4]

    Raises:
        ValueError: The numbers of times and poses differ, or a value is not finite.
    """
    if len(timestamps_s) != len(poses):
        raise ArgumentError(
            f"timestamps_s must hold {len(poses)} times, one per pose, got {len(timestamps_s)}"
        )
    if not (bool(torch.isfinite(poses).all()) and all(math.isfinite(t) for t in timestamps_s)):
        raise ArgumentError("timestamps_s and poses must be finite to be written as a trajectory")
    T = poses.detach().to("cpu", torch.float64)
    quat = quaternion.from_matrix(T[:, :3, :3])
    rows = torch.cat(
        [T[:, :3, 3], quat[:, [1, 2, 3, 0]]],
        dim=1,
    ).tolist()
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    lines += [
        " ".join(f"{v:.9f}" for v in (t, *row)) for t, row in zip(timestamps_s, rows, strict=True)
    ]
    write_file(path, "\n".join([*lines, ""]))


def read_trajectory_tum(path: str | Path) -> tuple[list[float], Float[Tensor, "N 4 4"]]:
    """Times (seconds) and camera-to-world poses (float64) of a trajectory file; ``#`` lines are
    skipped.

    Raises:
        FileNotFoundError: The file does not exist. ValueError: A line does not have 8 finite
            numbers with a unit quaternion, or its time is not after that of the previous line.
    """
    rows = []
    for number, line in enumerate(
        read_text(path, "a trajectory 't tx ty tz qx qy qz qw'").splitlines(), 1
    ):
        if line.strip() and not line.lstrip().startswith("#"):
            rows.append(_parse(line, f"{path} line {number}"))
            if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
                raise ArgumentError(
                    f"{path} line {number}: time {rows[-1][0]:.9g} does not come after "
                    f"{rows[-2][0]:.9g}"
                )
    table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 8)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    poses[:, :3, :3] = quaternion.to_matrix(table[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = table[:, 1:4]
    return [row[0] for row in rows], poses


def _parse(line: str, source: str) -> list[float]:
    try:
        values = [float(word) for word in line.split()]
    except ValueError:
        values = []
    if len(values) != 8 or not all(math.isfinite(v) for v in values):
        raise ArgumentError(
            f"{source} must have 8 finite numbers 't tx ty tz qx qy qz qw', got "
            f"{shown(line.strip())}"
        )
    if abs(math.hypot(*values[4:]) - 1) > 1e-2:
        raise ArgumentError(
            f"{source} must end in a unit quaternion, got one of length "
            f"{math.hypot(*values[4:]):.3g}"
        )
    return values
