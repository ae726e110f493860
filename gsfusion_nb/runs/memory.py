"""What a run says when a GPU's memory is full, and how its map is still saved."""

import torch

from ..mapping.gsfusion import GSFusion
from ..mapping.systems import Mapper
from ..tsdf import extract_mesh
from ..types import Mesh


def describe_full(mapper: Mapper) -> str:
    """What fills the memory, and which settings take less."""
    holds = [f"{len(mapper.gaussians):,} Gaussians ({mapper.gaussians.memory_bytes / 1e6:.0f} MB)"]
    less = ["smaller images (data.width)"]
    if isinstance(mapper, GSFusion):
        holds.append(f"{mapper.volume.n_blocks:,} voxel blocks ({mapper.volume.memory_bytes / 1e6:.0f} MB)")
        less += ["a larger seeding.quadtree_threshold", "larger voxels (tsdf.voxel_size_m)"]
    else:
        less.append("a smaller share in seeding.options")
    holds.append(f"{len(mapper.keyframes)} keyframes ({mapper.keyframes.size_bytes / 1e6:.0f} MB)")
    if mapper.config.keyframes_on == "device":
        less.append("keyframes in the memory of the processor (keyframes_on = 'cpu')")
    return f"the memory of {mapper.device} is full: it holds {', '.join(holds)}; try {', '.join(less)}"


def mesh_when_full(mapper: Mapper) -> Mesh:
    """The mesh without the memory of a GPU: of the volume on the processor; empty where it has to be rendered."""
    if mapper.device.type == "cuda":
        torch.cuda.empty_cache()
    if isinstance(mapper, GSFusion):
        return extract_mesh(mapper.volume.to("cpu"))
    return Mesh(vertices_W=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.int64), rgb=torch.zeros(0, 3))
