"""Small pieces of work that call an operation: the parity tests compare their results between
backends.

Each folder of ``kernels`` has a file of its name here, with a function ``cases()``.
"""

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfusion_nb.geometry import project
from gsfusion_nb.types import Camera, Frame, GaussianParams

WIDTH = 64
HEIGHT = 48


@dataclass(frozen=True, kw_only=True)
class Case:
    """One call, or a forward call with its gradient.

    ``run(device, dtype)`` makes its inputs the same way each time, calls the operations through
    their public names, so that the backend in use answers, and returns every result as a named
    tensor.
    """

    name: str
    """What is special about this case, for example "SH 3, without indices"."""
    operations: tuple[str, ...]
    """Names of the operations it calls."""
    run: Callable[[torch.device, torch.dtype], dict[str, Tensor]]
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    """Types of numbers that the operation takes."""
    tolerance: float = 1e-5
    """Largest difference between backends in float32, as a share of the largest value of the same
    tensor."""
    flips: float = 0.0
    """Share of the elements that may differ by more: those that lie within rounding of a
    threshold."""


def all_cases() -> Iterator[Case]:
    """The cases of every file here."""
    for file in pkgutil.iter_modules(__path__):
        yield from importlib.import_module(f"{__name__}.{file.name}").cases()


def make_frame(
    device: torch.device | str = "cpu", *, whole_numbers: bool = True, shift_m: float = 0.0
) -> Frame:
    """A checked, slanted wall 1.5 m away, 64 x 48 pixels; colours as from 8 bits, or between
    them."""
    v, u = torch.meshgrid(
        torch.arange(HEIGHT),
        torch.arange(WIDTH),
        indexing="ij",
    )
    levels = torch.stack(
        [(u // 7 + v // 5) % 2 * 200, u * 3, v * 4],
        dim=-1,
    )
    rgb = levels.byte() if whole_numbers else (levels + 0.4) / 255
    camera = Camera(
        width=WIDTH,
        height=HEIGHT,
        fx=50.0,
        fy=50.0,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
    )
    T_WC = torch.eye(4)
    T_WC[0, 3] = shift_m
    depth_m = 1.5 + 0.004 * u.float()
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_WC=T_WC,
    )
    return frame.to(device)


def make_params(
    sh_degree: int,
    device: torch.device | str,
    dtype: torch.dtype = torch.float32,
    n: int = 50,
) -> GaussianParams:
    """``n`` Gaussians of all shapes and opacities in front of the camera of ``make_frame``."""
    g = torch.Generator().manual_seed(0)
    params = GaussianParams(
        xyz_W=torch.rand(n, 3, generator=g) + torch.tensor([-0.5, -0.5, 1.5]),
        log_scale=0.5 * torch.randn(n, 3, generator=g) - 3.0,
        quat=torch.randn(n, 4, generator=g),
        opacity_logit=2.0 * torch.randn(n, generator=g),
        sh=0.4 * torch.randn(n, (sh_degree + 1) ** 2, 3, generator=g),
    )
    return GaussianParams(**{name: value.to(device, dtype) for name, value in vars(params).items()})


def make_sighted_points(n: int) -> tuple[Camera, Tensor, Tensor]:
    """The camera of ``make_frame``, ``n`` points [n, 3] and where it sees them, with noise [n, 2];
    float64.

    A quarter is seen 20 pixels off, and a tenth lies behind the camera.
    """
    g = torch.Generator().manual_seed(n)
    camera = make_frame().camera
    xyz_C = torch.rand(n, 3, generator=g, dtype=torch.float64) * 2 + torch.tensor([-1.0, -1.0, 1.0])
    uv = project(camera, xyz_C) + 0.5 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    uv[: n // 4] += 20.0
    xyz_C[n - n // 10 :] *= -1
    return camera, xyz_C, uv
