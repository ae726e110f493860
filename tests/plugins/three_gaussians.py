"""Three Gaussians over a slanted surface with a hole, whose picture and gradients were derived by
hand."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.geometry.spherical_harmonics import rgb_to_sh_dc
from gsfusion_nb.render.over_base import Base
from gsfusion_nb.types import Camera, GaussianParams


class Scene(NamedTuple):
    """What is drawn, and the picture that it is compared with."""

    params: GaussianParams
    camera: Camera
    T_WC: Tensor
    base: Base
    target: Tensor


def three_gaussians(dtype: torch.dtype) -> Scene:
    """The scene with values of a type."""

    def values(*rows: list[float] | float) -> Tensor:
        return torch.tensor(rows, dtype=dtype)

    cos = math.cos(math.radians(10))
    sin = math.sin(math.radians(10))
    T_CW = values(
        [cos, 0, sin, 0.05],
        [0, 1, 0, -0.02],
        [-sin, 0, cos, 0.1],
        [0, 0, 0, 1],
    )
    y, x = torch.meshgrid(
        torch.arange(12, dtype=dtype),
        torch.arange(16, dtype=dtype),
        indexing="ij",
    )
    depth_m = 2 + 0.02 * (x - 8)
    rgb = torch.stack(
        [0.3 + 0.02 * x, 0.5 + 0.01 * y, torch.full_like(x, 0.4)],
        dim=-1,
    )
    depth_m[:3, :4] = 0.0
    rgb[:3, :4] = 0.0
    params = GaussianParams(
        xyz_W=values([0.10, -0.05, 2.0], [-0.2, 0.1, 1.8], [0.15, 0.05, 2.05]),
        log_scale=values([0.12, 0.08, 0.02], [0.1, 0.15, 0.03], [0.2, 0.1, 0.05]).log(),
        quat=values([1, 0.2, -0.1, 0.3], [0.9, -0.3, 0.2, 0.1], [1, 0, 0, 0]),
        opacity_logit=values(0, 1, -0.5),
        sh=rgb_to_sh_dc(values([0.9, 0.2, 0.1], [0.1, 0.7, 0.4], [0.3, 0.3, 0.9]))[:, None],
    )
    return Scene(
        params=params,
        camera=Camera(width=16, height=12, fx=20.0, fy=21.0, cx=8.0, cy=6.0),
        T_WC=T_CW.inverse(),
        base=Base(rgb=rgb, depth_m=depth_m, weight=torch.ones_like(depth_m)),
        target=torch.stack([torch.full_like(x, 0.503), 0.307 + 0.03 * y, 0.211 + 0.02 * x], dim=-1),
    )
