"""Questions about the TSDF, with the frame fused into it."""

import functools
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ..errors import ArgumentError
from ..tsdf import RaycastOutput, TsdfVolume, raycast
from .inputs import SeedInputs, cached_result


def voxel_weight(inputs: SeedInputs, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Observation count of the voxels that contain the points; 0 where nothing was ever
    observed."""
    return _volume(inputs, "voxel_weight").sample_nearest(xyz_W).W


def tsdf(inputs: SeedInputs, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Signed distance of the voxels that contain the points, in units of the truncation
    distance."""
    return _volume(inputs, "tsdf").sample_nearest(xyz_W).D


def voxel_index(inputs: SeedInputs, xyz_W: Float[Tensor, "N 3"]) -> Int[Tensor, "N 3"]:
    """Integer coordinates of the voxels that contain the points, floor(xyz / voxel size). [N, 3]
    int64"""
    return (xyz_W / _volume(inputs, "voxel_index").config.voxel_size_m).floor().long()


def raycast_volume(inputs: SeedInputs) -> RaycastOutput:
    """The surface of the TSDF that the frame's camera sees, with this frame fused into it:
    ``depth_m`` [H, W], ``normal_W`` and ``rgb`` [H, W, 3]; zero where no ray meets one. In a mapper
    it needs a copy of the volume."""
    volume = _volume(inputs, "raycast_volume()")
    cast = functools.partial(raycast, volume) if isinstance(volume, TsdfVolume) else volume.raycast
    return cached_result(inputs, "raycast", lambda: cast(inputs.camera, inputs.frame.T_WC))


def _volume(inputs: SeedInputs, query: str) -> Any:
    if inputs.volume is None:
        raise ArgumentError(
            f"{query} needs a TSDF volume, but this {type(inputs).__name__} has none: pass "
            "volume=, or use a rule (or its option coverage=False) that needs none"
        )
    return inputs.volume
