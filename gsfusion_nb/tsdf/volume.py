"""The volumetric map: an unordered pool of 8^3 voxel blocks, found through a linear octree."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_saved, check_shape
from ..config import TsdfConfig, from_run, to_dict
from ..errors import ArgumentError
from ..geometry.operands import check_operand
from .block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK, BlockPool
from .cells import cell_corners, corner_weights
from .morton import encode
from .octree import BlockIndex, NewBlocks
from .voxels import block_of


@dataclass(frozen=True, kw_only=True, eq=False)
class TsdfSample:
    """Voxel values at points, or of whole blocks. Where no voxel is allocated: ``D`` 1, ``W`` 0,
    black."""

    D: Float[Tensor, "*N"]
    """Truncated signed distance, in units of the truncation distance, positive in front of the
    surface."""
    W: Float[Tensor, "*N"]
    """Observation count."""
    rgb: Float[Tensor, "*N 3"]
    """Mean colour, 0..1."""
    W_rgb: Float[Tensor, "*N"]
    """Weight of the colour; ``W`` where colours have no weights of their own."""


class TsdfVolume:
    """A sparse truncated signed distance field with colour.

    Voxel i of an axis spans [i, i + 1) voxel sizes from the world's origin, and its values stand
    for its centre. Block b holds voxels 8b .. 8b + 7; inside a block, voxel (x, y, z) is number 64
    x + 8 y + z. Blocks are created where they are needed, anywhere in the world, and keep their
    row.

    Args:
        config: Voxel size, truncation and the other settings.
        device: Device of the tensors.
        memory_limit_bytes: Refuse to grow beyond this; by default, beyond what the machine has
            available.
    """

    def __init__(
        self,
        config: TsdfConfig,
        device: torch.device | str = "cpu",
        *,
        memory_limit_bytes: int | None = None,
    ):
        self.config = config
        self.device = torch.device(device)
        self.memory_limit_bytes = memory_limit_bytes
        self.index = BlockIndex(device)
        self.pool = BlockPool(0, self.device, weighs_colours=config.weighs_colours)
        """The values of the blocks, with spare rows."""

    @property
    def n_blocks(self) -> int:
        """Number of allocated blocks."""
        return len(self.index)

    @property
    def D(self) -> Float[Tensor, "B 512"]:
        """Truncated signed distance of every voxel; 1 until observed. A view: writing to it changes
        the map."""
        return self.pool.D[: self.n_blocks]

    @property
    def W(self) -> Float[Tensor, "B 512"]:
        """Observation count of every voxel. A view."""
        return self.pool.W[: self.n_blocks]

    @property
    def rgb(self) -> Float[Tensor, "B 512 3"]:
        """Mean colour of every voxel, 0..1. A view of ``rgb_planes``."""
        return self.rgb_planes.transpose(1, 2)

    @property
    def rgb_planes(self) -> Float[Tensor, "B 3 512"]:
        """The colours as they are stored, one plane per channel: integration is 6 times faster on
        whole planes."""
        return self.pool.rgb[: self.n_blocks]

    @property
    def W_rgb(self) -> Float[Tensor, "B 512"]:
        """Weight of the colour of every voxel; ``W`` where colours have no weights of their own. A
        view."""
        return self.W if self.pool.W_rgb is None else self.pool.W_rgb[: self.n_blocks]

    @property
    def block_coords(self) -> Int[Tensor, "B 3"]:
        """Integer coordinates of every block, int32; times 8 voxel sizes gives its lower corner."""
        return self.pool.coords[: self.n_blocks]

    @property
    def block_size_m(self) -> float:
        """Edge of a block, metres."""
        return BLOCK_VOXELS * self.config.voxel_size_m

    def add_blocks(self, coords: Int[Tensor, "N 3"]) -> Int[Tensor, " K"]:
        """Allocate the blocks at ``coords`` that do not exist yet; returns their rows.

        Raises:
            MemoryError: before a growth that the machine (or ``memory_limit_bytes``) has no room
                for.
        """
        return self.allocate_missing(self.reserve(self.index.missing(coords)))

    def reserve(self, missing: NewBlocks) -> NewBlocks:
        """Make sure that blocks which do not exist yet (``index.missing``) can be allocated;
        returns them.

        No block is allocated yet: this is the part of ``add_blocks`` that can fail. The host waits
        for a GPU once.

        Raises:
            MemoryError: before a growth that the machine (or ``memory_limit_bytes``) has no room
                for.
        """
        if len(missing):
            self.pool = self._pool_for(self.n_blocks + len(missing))
        return missing

    def allocate_missing(self, missing: NewBlocks) -> Int[Tensor, " K"]:
        """Allocate the blocks that ``reserve`` returned; returns their rows."""
        n = self.n_blocks
        if len(missing):
            self.index.add(missing)
            self.pool.hand_out(n, missing.coords)
        return torch.arange(n, self.n_blocks, device=self.device)

    def voxel_index(self, xyz_W: Float[Tensor, "N 3"]) -> Int[Tensor, "N 3"]:
        """Integer coordinates of the voxels that contain the points. int64"""
        return torch.floor(xyz_W / self.config.voxel_size_m).to(torch.int64)

    def find_voxels(self, ijk: Int[Tensor, "*N 3"]) -> Int[Tensor, "*N"]:
        """Position of each voxel in the flattened pool (row * 512 + number in the block), -1 if not
        allocated. int64"""
        blocks = block_of(ijk).reshape(-1, 3)
        row = self.index.find(blocks).view(ijk.shape[:-1])
        x, y, z = (ijk & 7).unbind(-1)
        return torch.where(
            row < 0,
            -1,
            row * VOXELS_PER_BLOCK + 64 * x + 8 * y + z,
        )

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> TsdfSample:
        """Values of the voxels that contain the points.

        Args:
            xyz_W: Points, world frame, metres. [N, 3]

        Differentiable: no (the map is state, not a parameter).
        """
        return sample_voxels(self, xyz_W)

    def interpolate(
        self, xyz_W: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, " N"], Bool[Tensor, " N"]]:
        """Trilinear signed distance at points, in units of the truncation distance.

        Returns:
            ``D`` (1 where not valid) and ``valid``: all eight surrounding voxels have been
            observed.

        Differentiable: no (the map is state, not a parameter).
        """
        check_shape("xyz_W", xyz_W, ("N", 3))
        at, f = cell_corners(self, xyz_W)
        valid = is_observed(self, at).all(1)
        D = torch.ones_like(f[:, 0])
        around = self.D.view(-1)[at[valid]]
        D[valid] = (around * corner_weights(f[valid])).sum(1)
        return D, valid

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """Everything needed to continue: configuration and blocks; without ``copies`` later frames
        change them."""
        tensors = self.pool.stored(self.n_blocks)
        if copies:
            tensors = {name: x.clone() for name, x in tensors.items()}
        return {"config": to_dict(self.config)} | tensors

    def to(self, device: torch.device | str) -> "TsdfVolume":
        """A copy of the map on ``device``."""
        volume = TsdfVolume(self.config, device, memory_limit_bytes=self.memory_limit_bytes)
        _take(volume, self.pool.stored(self.n_blocks))
        return volume

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Replace the map by one saved with ``state_dict``; its configuration must be the same.

        Raises:
            ValueError: Another configuration, tensors of other types or sizes, numbers that are not
                finite, a negative weight, or a block that is stored twice or lies outside the index
                range.
        """
        config = from_run(TsdfConfig, state["config"])
        if config != self.config:
            raise ArgumentError(
                f"the saved map was made with {config}, this volume has {self.config}"
            )
        _check_saved_blocks(state)
        _take(
            self,
            {name: state[name] for name in ("D", "W", "rgb", "block_coords")}
            | {"W_rgb": _colour_weights(state)},
        )

    def _pool_for(self, n_blocks: int) -> BlockPool:
        limit_bytes = self.memory_limit_bytes
        voxel_size_m = self.config.voxel_size_m
        return self.pool.with_room_for(n_blocks, limit_bytes=limit_bytes, voxel_size_m=voxel_size_m)


def _take(volume: TsdfVolume, tensors: dict[str, Tensor]) -> None:
    """Replace the blocks of a volume by those of ``BlockPool.stored``, which may be on another
    device, whose memory may be full."""
    coords = tensors["block_coords"].to(volume.device)
    volume.pool = BlockPool(0, volume.device, weighs_colours=volume.config.weighs_colours)
    volume.pool = volume._pool_for(len(coords))
    volume.index = BlockIndex.of_blocks(coords)
    volume.pool.fill(tensors)


def is_observed(volume: TsdfVolume, flat: Int[Tensor, "*N"]) -> Bool[Tensor, "*N"]:
    """Whether voxels, given by their position in the flattened pool, are allocated (not -1) and
    have a weight."""
    allocated = flat >= 0
    observed = torch.zeros_like(allocated)
    observed[allocated] = volume.W.view(-1)[flat[allocated]] > 0
    return observed


def _check_saved_blocks(state: dict[str, Any]) -> None:
    coords = state["block_coords"]
    check_saved("block_coords", coords, ("B", 3), torch.int32)
    n = len(coords)
    for name, shape in (
        ("D", (n, VOXELS_PER_BLOCK)),
        ("W", (n, VOXELS_PER_BLOCK)),
        ("rgb", (n, 3, VOXELS_PER_BLOCK)),
    ):
        check_saved(name, state[name], shape)
    check_saved("W_rgb", _colour_weights(state), (n, VOXELS_PER_BLOCK))
    if len(encode(coords).unique()) != n:
        raise ArgumentError("block_coords must contain every block once")
    for name, weights in (("W", state["W"]), ("W_rgb", _colour_weights(state))):
        if n and float(weights.min()) < 0:
            raise ArgumentError(
                f"{name} must be at least 0 in every voxel, got {float(weights.min()):g}"
            )


def _colour_weights(state: dict[str, Any]) -> Tensor:
    """Of a saved map; files without them have the observation counts."""
    return state.get("W_rgb", state["W"])


def check_volume(volume: Any) -> None:
    """Raise ``ValueError`` unless this is a volume."""
    if not isinstance(volume, TsdfVolume):
        raise ArgumentError(f"volume must be a TsdfVolume, got {type(volume).__name__}")


def check_sample(volume: Any, xyz_W: Any) -> None:
    """Raise ``ValueError`` for arguments that ``sample_voxels`` refuses."""
    check_volume(volume)
    check_operand("xyz_W", xyz_W, ("N", 3), device=volume.D.device)


def rgb_at(volume: TsdfVolume, flat: Int[Tensor, "*N"]) -> Float[Tensor, "*N 3"]:
    """Colours of allocated voxels, given by their position in the flattened pool."""
    return volume.rgb_planes[flat // VOXELS_PER_BLOCK, :, flat % VOXELS_PER_BLOCK]


@op("sample", check_sample)
def sample_voxels(volume: TsdfVolume, xyz_W: Float[Tensor, "N 3"]) -> TsdfSample:
    """Values of the voxels that contain the points; the operation behind
    ``TsdfVolume.sample_nearest``."""
    at = volume.find_voxels(volume.voxel_index(xyz_W))
    known = at >= 0
    at = at[at >= 0]
    D = xyz_W.new_ones(len(known))
    W = xyz_W.new_zeros(len(known))
    rgb = xyz_W.new_zeros(len(known), 3)
    W_rgb = torch.zeros_like(W)
    D[known] = volume.D.view(-1)[at]
    W[known] = volume.W.view(-1)[at]
    rgb[known] = rgb_at(volume, at)
    W_rgb[known] = volume.W_rgb.view(-1)[at]
    return TsdfSample(D=D, W=W, rgb=rgb, W_rgb=W_rgb)
