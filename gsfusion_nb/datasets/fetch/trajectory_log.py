"""Open3D's ``trajectory.log``: per frame a line of three numbers, then the four rows of its camera-to-world matrix."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..poses import read_words
from .errors import FetchError


def read_trajectory_log(path: Path) -> Float[Tensor, "N 4 4"]:
    """Camera-to-world poses in the file's order, float64. [N, 4, 4]

    Raises:
        FetchError: a number of lines that is no multiple of five, or a line that does not hold what it should.
    """
    lines = read_words(path, "a trajectory log")
    if len(lines) % 5:
        raise FetchError(f"{path} holds {len(lines)} lines; expected five per pose")
    try:
        rows = [[float(word) for word in words] for i, (_, words) in enumerate(lines) if i % 5]
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 4, 4)
    except (ValueError, RuntimeError) as e:
        raise FetchError(f"{path} must hold a line of three numbers and four of four per pose ({e})") from None


def write_pose_lines(path: Path, T_WC: Float[Tensor, "N 4 4"]) -> None:
    """Write ``poses.txt`` or ``traj.txt``: 16 row-major numbers per line."""
    lines = (" ".join(f"{value:.9g}" for value in pose) for pose in T_WC.double().flatten(1).tolist())
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
