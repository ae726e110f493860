"""Nearest neighbours of points: a k-d tree on the CPU, all distances on a GPU."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_DISTANCES = 1 << 25
"""Number of distances computed at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbours:
    """The nearest neighbours of M points, nearest first, never the point itself."""

    distance_m: Float[Tensor, "M K"]
    """Distance, metres; infinite where there are fewer than K neighbours."""
    row: Int[Tensor, "M K"]
    """Rows of the neighbours, -1 where there is none."""

    @property
    def spacing_m(self) -> Float[Tensor, " M"]:
        """Root mean square of the distances that exist, metres; NaN without any. The square root of what 3DGS calls the
        mean squared distance to the 3 nearest neighbours (simple-knn)."""
        exists = self.distance_m.isfinite()
        return (self.distance_m.where(exists, 0.0).square().sum(dim=1) / exists.sum(dim=1)).sqrt()


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


def nearest_of(xyz_W: Float[Tensor, "M 3"], others_W: Float[Tensor, "N 3"], k: int) -> Neighbours:
    """The ``k`` nearest of ``others_W`` for each point. Differentiable: no."""
    distance, row = k_nearest(xyz_W, others_W, k)
    return Neighbours(distance_m=distance, row=row.masked_fill(row == len(others_W), -1))


def nearest_others(xyz_W: Float[Tensor, "M 3"], more_W: Float[Tensor, "N 3"], k: int) -> Neighbours:
    """The ``k`` nearest neighbours of each point among the other points and ``more_W``.

    A point at the same place as another one has it as a neighbour at distance 0. Differentiable: no.
    """
    M = len(xyz_W)
    everything = torch.cat([xyz_W, more_W])
    distance, row = k_nearest(xyz_W, everything, k + 1)
    other = row != torch.arange(M, device=row.device)[:, None]
    other[other.all(dim=1), -1] = False  # a duplicate hid the point itself: leave out the farthest
    kept = other.byte().sort(dim=1, descending=True, stable=True).indices[:, :k]
    row = row.gather(1, kept)
    return Neighbours(distance_m=distance.gather(1, kept), row=row.masked_fill(row == len(everything), -1))


def outliers(xyz_W: Float[Tensor, "M 3"], neighbours: int = 40, std_ratio: float = 2.0) -> Bool[Tensor, " M"]:
    """Points whose mean distance to their neighbours exceeds that of all points by ``std_ratio`` standard deviations.

    The statistical outlier filter of point cloud libraries (Rusu et al. 2008). With fewer points, all others are the
    neighbours of each. Differentiable: no.
    """
    k = min(neighbours, len(xyz_W) - 1)
    if k < 1:
        return torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
    mean = nearest_others(xyz_W, xyz_W[:0], k).distance_m.mean(dim=1)
    return mean > mean.mean() + std_ratio * mean.std()


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
