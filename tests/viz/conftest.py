"""Shared by the tests of the viewers: a tiny wall of Gaussians, a recording of a textured wall."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import apply_options
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.types import Camera, Frame, Seeds


@pytest.fixture
def model():
    """Two Gaussians on the x axis: red at x = -0.5, green at x = +0.5; born at frames 3 and 7, tags
    1 and 5."""
    model = GaussianModel(sh_degree=0)
    for x, rgb, frame, tag in ((-0.5, (1.0, 0.0, 0.0), 3, 1), (0.5, (0.0, 1.0, 0.0), 7, 5)):
        seeds = Seeds.isotropic(
            torch.tensor([[x, 0.0, 0.0]]),
            torch.tensor([rgb]),
            torch.tensor([0.15]),
            opacity=0.99,
            tag=torch.tensor([tag]),
        )
        model.append(seeds, frame)
    return model


@dataclasses.dataclass(frozen=True, eq=False)
class Wall:
    """A camera that slides along a striped wall two metres away; ``broken`` frames raise when
    read."""

    n: int = 6
    broken: tuple[int, ...] = ()
    name: str = "wall"
    step_m: float = 0.04
    camera: Camera = dataclasses.field(
        default_factory=lambda: Camera(
            width=48,
            height=36,
            fx=40.0,
            fy=40.0,
            cx=24.0,
            cy=18.0,
        )
    )

    def __len__(self) -> int:
        return self.n

    def pose(self, i: int) -> torch.Tensor:
        T = torch.eye(4)
        T[0, 3] = self.step_m * i
        return T

    def __getitem__(self, i: int) -> Frame:
        if i >= self.n:
            raise IndexError(i)
        if i in self.broken:
            raise RuntimeError(f"the film tore at frame {i}")
        x = (torch.arange(48) + 0.5 - 24) / 40 * 2 + self.step_m * i
        stripes = 0.5 + 0.5 * torch.sin(2 * math.pi * x / 0.3)
        rgb = (
            torch.stack([stripes, 1 - stripes, torch.full_like(stripes, 0.5)], -1)
            .expand(36, 48, 3)
            .contiguous()
        )
        depth_m = torch.full((36, 48), 2.0)
        return Frame(
            index=i,
            timestamp_s=0.1 * i,
            rgb=rgb,
            depth_m=depth_m,
            camera=self.camera,
            T_WC=self.pose(i),
        )


@pytest.fixture
def make_run():
    """``make_run(n=..., broken=...)`` is a fresh run over the wall."""

    def make(**options) -> MappingRun:
        config = gsfusion(
            "online",
            tsdf__voxel_size_m=0.05,
            seeding__quadtree_contrast="std",
            data__hold_out_every=0,
            sh_degree=0,
        )
        return MappingRun(apply_options(Wall(**options), config.data), make_mapper(config))

    return make
