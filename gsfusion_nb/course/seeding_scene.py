"""A wall before a camera, on which the rules of chapter 9 are judged."""

from types import SimpleNamespace

import torch
from torch import Tensor

from ..config import SeedingConfig, TsdfConfig
from ..seeding import SeedContext
from ..types import Camera, Frame, GaussianParams


def wall_context(covered: str = "nothing") -> SeedContext:
    """A chequered wall 2 m away, seen by 64 x 48 pixels; "quarter": opaque Gaussians on its upper left quarter."""
    camera = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
    j, i = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    grey = (((i // 4) + (j // 4)) % 2).float() * 0.8 + 0.1
    frame = Frame(
        index=0, timestamp_s=0.0, rgb=grey[..., None].expand(-1, -1, 3).contiguous(),
        depth_m=torch.full((48, 64), 2.0), camera=camera, T_WC=torch.eye(4),
    )  # fmt: skip
    x, y = torch.meshgrid(torch.linspace(-1.2, -0.1, 12), torch.linspace(-0.9, -0.1, 9), indexing="xy")
    xyz = torch.stack([x, y, torch.full_like(x, 2.0)], dim=-1).reshape(-1, 3)
    if covered == "nothing":
        xyz = xyz[:0]
    n = len(xyz)
    params = GaussianParams(
        xyz_W=xyz, log_scale=torch.full((n, 3), 0.06).log(), quat=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).clone(),
        opacity_logit=torch.full((n,), 4.0), sh=torch.zeros(n, 1, 3),
    )  # fmt: skip
    config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    return SeedContext(frame, _FreshVolume(), SimpleNamespace(params=params), config=config)


class _FreshVolume:
    """Every voxel was observed once."""

    config = TsdfConfig(voxel_size_m=0.02)

    def sample_nearest(self, xyz_W: Tensor) -> SimpleNamespace:
        return SimpleNamespace(D=torch.zeros(len(xyz_W)), W=torch.ones(len(xyz_W)))
