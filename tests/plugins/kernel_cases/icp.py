"""Normal equations of point-to-plane ICP.

Cases of ``icp_system``: a curved wall seen twice, with narrow and with wide gates.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import DepthLevel, Surface, icp_system
from gsfusion_nb.types import Camera

from . import HEIGHT, WIDTH, Case, make_frame


def cases() -> Iterator[Case]:
    """With and without weights that fall with the depth."""
    for even_to_m in (None, 1.0):
        for gates in ((0.02, 0.9), (10.0, -1.1)):
            run = functools.partial(_sums, gates, even_to_m)
            yield Case(
                name=f"even_to_m={even_to_m}, gates {gates}", operations=("icp_system",), run=run
            )


def _sums(
    gates: tuple[float, float],
    even_to_m: float | None,
    device,
    dtype,
) -> dict[str, Tensor]:
    frame = make_frame()
    level = DepthLevel(
        factor=1, camera=frame.camera, **_wall(frame.camera, device, dtype, "normal_C")
    )
    camera = frame.camera.resized(WIDTH * 3 // 2, HEIGHT)
    surface = Surface(
        camera=camera,
        T_WC=torch.eye(4, device=device),
        **_wall(camera, device, dtype, "normal_W"),
    )
    T_WC = se3.exp(torch.tensor([0.01, 0.02, -0.01, 0.01, -0.015, 0.02]).double()).to(device)
    system = icp_system(
        level, T_WC, surface, max_distance_m=gates[0], min_cosine=gates[1], even_to_m=even_to_m
    )
    return {name: torch.as_tensor(value) for name, value in vars(system).items()}


def _wall(camera: Camera, device, dtype, normals: str) -> dict[str, Tensor]:
    """Depth of waves on a wall 1.5 m away, with holes, and its normals in the camera frame."""
    v, u = torch.meshgrid(
        torch.arange(camera.height),
        torch.arange(camera.width),
        indexing="ij",
    )
    x = (u + 0.5) / camera.width
    y = (v + 0.5) / camera.height
    depth_m = 1.5 + 0.1 * torch.sin(9 * x) * torch.cos(7 * y) + 0.2 * x
    depth_m[5:9, 10:20] = 0.0
    depth_m = depth_m.to(device, dtype)
    return {"depth_m": depth_m, normals: depth_to_normals(camera, depth_m)}
