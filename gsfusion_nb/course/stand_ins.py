"""What judges pass in place of a recording, a volume and an optimiser. A submission sees them, so
no solution is here."""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ..config import TsdfConfig
from ..mapping import GSFusion
from ..optim import Keyframe
from ..types import Camera, Frame


def chequered_wall(index: int = 0, *, square_px: int = 8) -> Frame:
    """A wall 2 m away with grey squares of so many pixels, seen by 64 x 48 pixels from the
    origin."""
    camera = Camera(
        width=64,
        height=48,
        fx=60.0,
        fy=60.0,
        cx=32.0,
        cy=24.0,
    )
    row, column = torch.meshgrid(
        torch.arange(48),
        torch.arange(64),
        indexing="ij",
    )
    grey = (((column // square_px) + (row // square_px)) % 2).float() * 0.8 + 0.1
    return Frame(
        index=index,
        timestamp_s=float(index),
        rgb=grey[..., None].expand(-1, -1, 3).contiguous(),
        depth_m=torch.full((48, 64), 2.0),
        camera=camera,
        T_WC=torch.eye(4),
    )


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
