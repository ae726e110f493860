"""What a seeding rule may ask about points: neighbours, occupied voxels, outliers, random draws, orientations."""

from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import quaternion
from ..types import Frame
from .draws import draw, draw_weighted
from .map_view import MapView
from .nearest import Neighbours, nearest_of, nearest_others, outliers
from .voxel_hash import VoxelHash, first_in_voxel


class PointQueries:
    """The part of ``SeedContext`` that answers questions about points."""

    frame: Frame
    gaussians: Any
    generator: torch.Generator

    @property
    def map(self) -> MapView:
        """The Gaussians that exist before this frame."""
        raise NotImplementedError

    @property
    def has_map(self) -> bool:
        """Whether the map has any Gaussian; False also without a map."""
        return self.gaussians is not None and len(self.gaussians.params) > 0

    def nearest(
        self, xyz_W: Float[Tensor, "M 3"], k: int = 3, among: Literal["new", "map", "new and map"] = "new"
    ) -> Neighbours:
        """The ``k`` nearest neighbours of each point; ``nearest(xyz_W).spacing_m`` is the usual size of a new Gaussian.

        Args:
            xyz_W: New points, world frame, metres. [M, 3]
            k: Number of neighbours.
            among: "new": the other new points; "map": the Gaussians of the map; "new and map": both.

        Returns:
            ``distance_m`` and ``row``, [M, k]. Rows count the new points first, then the map's, with "map" only the
            map's.
        """
        existing = self.map.xyz_W if among != "new" and self.has_map else xyz_W[:0]
        return nearest_of(xyz_W, existing, k) if among == "map" else nearest_others(xyz_W, existing, k)

    def occupied(self, xyz_W: Float[Tensor, "M 3"], voxel_size_m: float) -> Bool[Tensor, " M"]:
        """Whether the voxel that contains each point holds the centre of a Gaussian of the map. [M]

        The voxels are those of a grid at the world's origin and are independent of the TSDF. Keeping only points in
        voxels that are not occupied, and of those the ones of ``first_in_voxel``, gives one Gaussian a voxel in the
        whole map, as long as the optimisation does not move them into another voxel.

        Args:
            xyz_W: Points, world frame, metres. [M, 3]
            voxel_size_m: Edge length of a voxel, metres.
        """
        if not self.has_map:
            return torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
        held = self._once(("voxel hash", voxel_size_m), lambda: VoxelHash(self.map.xyz_W, voxel_size_m))
        return held.contains(xyz_W)

    def first_in_voxel(self, xyz_W: Float[Tensor, "M 3"], voxel_size_m: float) -> Bool[Tensor, " M"]:
        """True for the first of the points in each voxel. [M]"""
        return first_in_voxel(xyz_W, voxel_size_m)

    def outliers(self, xyz_W: Float[Tensor, "M 3"], k: int = 40, std_ratio: float = 2.0) -> Bool[Tensor, " M"]:
        """Points whose mean distance to their ``k`` nearest others exceeds the mean of all points by ``std_ratio``
        standard deviations (the statistical outlier filter, Rusu et al. 2008). [M]"""
        return outliers(xyz_W, k, std_ratio)

    def draw(self, n: int, count: int) -> Int[Tensor, " K"]:
        """``count`` of the numbers 0 .. n - 1 at random, without replacement, in increasing order; all if there are
        fewer. On the frame's device. [K]"""
        return draw(n, count, self.generator).to(self.frame.depth_m.device)

    def draw_weighted(self, weight: Float[Tensor, " N"], count: int) -> Int[Tensor, " K"]:
        """``count`` rows at random, without replacement, with probabilities in proportion to ``weight`` (>= 0), in
        increasing order; rows of weight 0 are never drawn. [K]"""
        return draw_weighted(weight, count, self.generator)

    def quat_from_normals(self, normal: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
        """Unit quaternions, wxyz, that turn the z axis to the normals by the smaller angle; a disc is then thin along
        z. A normal need not have unit length; a zero one gives the identity. [M, 4]"""
        return quat_from_normals(normal)

    def _once(self, key: Any, make: Any) -> Any:
        raise NotImplementedError


def quat_from_normals(normal: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
    """The rotation from the z axis to each normal; the identity where the normal is zero."""
    length = normal.norm(dim=1, keepdim=True)
    z = torch.zeros_like(normal)
    z[:, 2] = 1.0
    return quaternion.shortest_arc(z, torch.where(length > 0, normal / length, z))
