"""Nearest neighbours of points: a k-d tree on the CPU, all distances on a GPU."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

_DISTANCES = 1 << 25
"""Number of distances computed at a time."""


def k_nearest(
    xyz_W: Float[Tensor, "M 3"], others_W: Float[Tensor, "N 3"], k: int
) -> tuple[Float[Tensor, "M K"], Int[Tensor, "M K"]]:
    """Distance to the ``k`` nearest of ``others_W`` and their rows, nearest first; if there are fewer,
    infinite and row N. On the device of the points; differentiable: no."""
    M, N = len(xyz_W), len(others_W)
    if M == 0 or N == 0:
        return xyz_W.new_full((M, k), torch.inf), torch.full((M, k), N, dtype=torch.int64, device=xyz_W.device)
    if xyz_W.device.type == "cpu":
        from scipy.spatial import KDTree

        distance, row = KDTree(others_W.numpy()).query(xyz_W.numpy(), k=k)
        return torch.from_numpy(distance).view(M, k).to(xyz_W), torch.from_numpy(row).view(M, k)
    return by_all_distances(xyz_W, others_W, k)


def by_all_distances(
    xyz_W: Float[Tensor, "M 3"], others_W: Float[Tensor, "N 3"], k: int
) -> tuple[Float[Tensor, "M K"], Int[Tensor, "M K"]]:
    """``k_nearest`` for thousands of points among tens of thousands, without leaving the device."""
    N = len(others_W)
    missing = (0, max(k - N, 0))
    found = []
    for some in xyz_W.split(max(_DISTANCES // N, 1)):
        distance = torch.cdist(some, others_W, compute_mode="donot_use_mm_for_euclid_dist")
        nearest, row = distance.topk(min(k, N), largest=False)
        pad = torch.nn.functional.pad
        found.append((pad(nearest, missing, value=torch.inf), pad(row, missing, value=N)))
    distances, rows = zip(*found, strict=True)
    return torch.cat(distances), torch.cat(rows)
