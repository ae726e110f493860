"""Message of a run when the memory is full, and how its mesh is still saved."""

import torch

from ..mapping import Mapper
from ..types import Mesh


def describe_full(mapper: Mapper) -> str:
    """A sentence that says what fills the memory, and which settings need less."""
    holds = [f"{part.count:,} {part.name} ({part.size_bytes / 1e6:.0f} MB)" for part in mapper.parts()]
    less = ["smaller images (data.width)", *mapper.memory_savers]
    if mapper.config.keyframes_on == "device":
        less.append("keyframes in CPU memory (keyframes_on = 'cpu')")
    return f"the memory of {mapper.device} is full: it holds {', '.join(holds)}; try {', '.join(less)}"


def mesh_when_full(mapper: Mapper) -> Mesh:
    """The mesh, extracted on the CPU; empty if the system cannot do that."""
    if mapper.device.type == "cuda":
        torch.cuda.empty_cache()
    return mapper.mesh_on_cpu() or Mesh(
        vertices_W=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.int64), rgb=torch.zeros(0, 3)
    )
