"""What judges pass in place of a volume and of an optimiser. A submission sees them, so no solution
is here."""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ..config import TsdfConfig
from ..mapping import GSFusion
from ..optim import Keyframe
from ..types import Frame


class FreshVolume:
    """Every voxel was observed once."""

    config = TsdfConfig(voxel_size_m=0.02)

    def sample_nearest(self, xyz_W: Tensor) -> SimpleNamespace:
        """D = 0 and W = 1 at each of the points [N, 3]."""
        return SimpleNamespace(
            D=torch.zeros(len(xyz_W)),
            W=torch.ones(len(xyz_W)),
        )


class Log:
    """Stands in for the optimiser: remembers which view was optimised, and how many Gaussians there
    were."""

    def __init__(self, mapper: GSFusion):
        self.mapper = mapper
        self.calls: list[tuple[str, int, int]] = []

    def __call__(self, view: "Frame | Keyframe") -> None:
        kind = "keyframe" if isinstance(view, Keyframe) else "frame"
        self.calls.append((kind, view.index, len(self.mapper.gaussians)))

    def state_dict(self) -> dict[str, Any]:
        """The calls so far, as data."""
        return {"calls": list(self.calls)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` gave, in place."""
        self.calls[:] = [(str(kind), int(index), int(n)) for kind, index, n in state["calls"]]
