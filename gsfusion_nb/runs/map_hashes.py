"""One hash per map: equal hashes mean maps that are equal bit for bit."""

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor

from ..types import Mesh
from .mapping_run import MappingRun


def map_hashes(run: MappingRun, mesh: Mesh | None = None) -> dict[str, str]:
    """SHA-256 of each map of a run, by name: "gaussians", "trajectory", "tsdf" if the system has one, and "mesh" if it
    is given; it follows from the others."""
    trajectory = {
        "frame_index": torch.tensor(run.mapper.localiser.frame_indices, dtype=torch.int64),
        "T_WC": torch.stack(run.mapper.localiser.poses) if run.mapper.localiser.poses else torch.zeros(0, 4, 4),
    }
    maps = run.mapper.maps() | {"trajectory": trajectory} | ({} if mesh is None else {"mesh": vars(mesh)})
    return {name: hash_of(tensors) for name, tensors in maps.items()}


def hash_of(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named tensors, sorted by name. Of each tensor the name, type and shape are hashed as text, then its
    numbers, row by row, in little-endian byte order."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        values = tensor.detach().cpu().contiguous().numpy()
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {values.dtype.name} {list(values.shape)}\n".encode())
        digest.update(values.reshape(-1).view("uint8").data)
    return digest.hexdigest()
