"""Sums of the brightness error that joins ICP.

Cases of ``brightness_system``: a patterned, curved wall seen twice, in the same and in another
exposure.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import DepthLevel, Surface, brightness_system, picture_of
from gsfusion_nb.types import Camera

from . import HEIGHT, WIDTH, Case, make_frame


def cases() -> Iterator[Case]:
    """With a narrow and a wide limit of depth."""
    for limit_m in (0.02, 10.0):
        run = functools.partial(_sums, limit_m)
        yield Case(name=f"max_distance_m={limit_m}", operations=("brightness_system",), run=run)


def _sums(limit_m: float, device, dtype) -> dict[str, Tensor]:
    camera = make_frame().camera
    depth_m, brightness = (image.to(device, dtype) for image in _wall(camera))
    level = DepthLevel(
        factor=1, camera=camera, depth_m=depth_m, normal_C=depth_to_normals(camera, depth_m)
    )
    other = camera.resized(WIDTH * 3 // 2, HEIGHT)
    surface_m, picture = (image.to(device, dtype) for image in _wall(other))
    normal_W = depth_to_normals(other, surface_m)
    T_WS = torch.eye(4, device=device)
    surface = Surface(depth_m=surface_m, normal_W=normal_W, camera=other, T_WC=T_WS)
    seen = picture_of(
        surface,
        picture[..., None].expand(-1, -1, 3),
        1,
    )
    T_WC = se3.exp(torch.tensor([0.01, 0.02, -0.01, 0.01, -0.015, 0.02]).double()).to(device)
    system = brightness_system(
        level, 0.9 * brightness, T_WC, seen, max_distance_m=limit_m, offset=0.05
    )
    return {name: torch.as_tensor(value) for name, value in vars(system).items()}


def _wall(camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth of waves on a wall 1.5 m away, with holes, and waves of brightness."""
    v, u = torch.meshgrid(
        torch.arange(camera.height),
        torch.arange(camera.width),
        indexing="ij",
    )
    x = (u + 0.5) / camera.width
    y = (v + 0.5) / camera.height
    depth_m = 1.5 + 0.1 * torch.sin(9 * x) * torch.cos(7 * y) + 0.2 * x
    depth_m[5:9, 10:20] = 0.0
    return depth_m, 0.5 + 0.3 * torch.sin(17 * x + 3 * y) * torch.cos(11 * y)
