"""A hash of each map of a run: two runs with equal hashes made the same map."""

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor

from ..resources import MAP_MEMORY
from ..types import Mesh
from .mapping_run import MappingRun

_ROWS_AT_A_TIME = 8192
"""Of a map that is hashed, which limits the memory."""


def map_hashes(run: MappingRun, mesh: Mesh | None = None) -> dict[str, str]:
    """SHA-256 of each map of a run, by name: "gaussians", "trajectory", "tsdf" if the system has
    one, and "mesh" if it is given; it follows from the others."""
    trajectory = {
        "frame_index": torch.tensor(run.mapper.trajectory.frame_indices, dtype=torch.int64),
        "T_WC": torch.stack(run.mapper.trajectory.poses)
        if run.mapper.trajectory.poses
        else torch.zeros(0, 4, 4),
    }
    maps = (
        run.mapper.files.maps()
        | {"trajectory": trajectory}
        | ({} if mesh is None else {"mesh": vars(mesh)})
    )
    return {
        name: hash_of(tensors, run.mapper.files.order_of_rows(name))
        for name, tensors in maps.items()
    }


def hash_of(tensors: Mapping[str, Tensor], order: Tensor | None = None) -> str:
    """SHA-256 of named tensors, sorted by name. Of each tensor the name, type and shape are hashed
    as text, then its numbers, row by row, in little-endian byte order; ``order``: row numbers, if
    not as they are."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(
            f"{name} {str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}\n".encode()
        )
        rows = (tensor if order is None else order).split(_ROWS_AT_A_TIME)
        for part in rows if order is None else (tensor[places] for places in rows):
            values = part.detach().cpu().contiguous().numpy()
            digest.update(
                values.astype(values.dtype.newbyteorder("<"), copy=False)
                .reshape(-1)
                .view("uint8")
                .data
            )
            MAP_MEMORY.give_back()
    return digest.hexdigest()
