"""Poses as lines of text, as several layouts hold them."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor


def write_pose_lines(path: Path, T_WC: Float[Tensor, "N 4 4"]) -> None:
    """Write ``poses.txt`` or ``traj.txt``: 16 row-major numbers per line."""
    lines = (" ".join(f"{value:.9g}" for value in pose) for pose in T_WC.double().flatten(1).tolist())
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
