"""The main operations of a mapping step on random data, with their flop and bytes.

These are counted by hand, from the formulas; bytes are those that must move at least once (inputs
read, outputs written). Further work of a kernel (sorting, gathering, reading twice) shows as a
lower speed.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from ..config import TsdfConfig
from ..optim import ColumnRates, adam_update_map, dssim_vjp, l1_mse_vjp
from ..render import render_forward, render_vjp
from ..tsdf import TsdfVolume, allocate
from ..tsdf.integrate import fuse_frame_
from ..types import Frame, GaussianParams
from .bench.scene import random_scene

_ROW = {"xyz_W": (3,), "log_scale": (3,), "quat": (4,), "opacity_logit": (), "sh": (16, 3)}
FLOATS_PER_GAUSSIAN = sum(math.prod(shape) for shape in _ROW.values())
"""Centre, log scale, quaternion, opacity, SH of degree 3."""

ADAM_FLOPS = 12
ADAM_FLOATS = 7
"""Per number. m: 3, v: 4, step: sqrt, +, /, x, - = 5. Read value, gradient, m, v; write value, m,
v."""
FORWARD_FLOPS = 30
"""Per pair (pixel, Gaussian): sigma 10, exp counted as 8, alpha 2, transmittance 2, four channels
and alpha 8."""
BACKWARD_FLOPS = 70
"""Per pair: alpha again 20, dL/dalpha 12, dL/dcolour 8, dL/dconic, dL/duv, dL/dopacity 30."""
SSIM_FLOPS = 5 * 2 * 11 * 2 + 3 * 2 * 11 * 2 + 40
"""Per number: five maps blurred forwards and three backwards, each with an 11-tap filter twice, and
the quotient."""
L1_FLOPS = 9
L1_FLOATS = 3
"""Per number: difference, size, sign, clamp, square, two sums. Read picture and photograph, write
the gradient."""
TSDF_FLOPS = 40
TSDF_FLOATS = 10
"""Per observed voxel: projection 12, distance along the ray 10, three running means 18. Read and
write distance, weight and colour."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """An operation to time, with its counted flop and bytes."""

    name: str
    operations: tuple[str, ...]
    """Names of operations, see ``backends.operations``."""
    run: Callable[[], object]
    flops: float | int
    bytes: float | int


def mapping_work(
    n: int = 20_000,
    width: int = 320,
    height: int = 240,
    per_pixel: float = 30.0,
    device: str = "cpu",
) -> list[Work]:
    """The main operations of a mapping step, on a random scene.

    Args:
        n: Number of Gaussians, with SH of degree 3; Adam gets five times as many, which do not fit
            in a cache.
        width, height: Size of the image, pixels.
        per_pixel: Mean number of Gaussians above alpha = 1/255 at a pixel.
        device: Where the tensors are.
    """
    scene = random_scene(n, width, height, sh_degree=3, per_pixel=per_pixel).to(device)
    pixels = width * height
    numbers = n * FLOATS_PER_GAUSSIAN
    pairs = per_pixel * pixels
    g = torch.Generator().manual_seed(0)
    rows = 5 * n  # too much for a cache
    params, gradients, m, v = (
        GaussianParams(
            **{
                name: torch.rand(rows, *shape, generator=g).to(device)
                for name, shape in _ROW.items()
            }
        )
        for _ in range(4)
    )
    rates = ColumnRates(*[1e-3] * len(ColumnRates._fields))
    image, target = (torch.rand(height, width, 3, generator=g).to(device) for _ in range(2))
    depth_m = (1.5 + 0.5 * torch.rand(height, 1, generator=g)).expand(height, width).contiguous()
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=image.cpu(),
        depth_m=depth_m,
        camera=scene.camera,
        T_WC=torch.eye(4),
    ).to(device)

    def forward():
        return render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)

    @functools.cache
    def saved():
        return forward()[1]

    def backward():
        return render_vjp(saved(), scene.v_rgb)

    @functools.cache
    def volume() -> tuple[TsdfVolume, int]:
        """A volume after the frame, and the number of observed voxels."""
        new_volume = TsdfVolume(TsdfConfig(), device=device)
        allocate(new_volume, frame)
        return new_volume, fuse_frame_(new_volume, frame)

    voxels = volume()[1]
    return [
        Work(
            name="Adam",
            operations=("adam_update_map",),
            flops=ADAM_FLOPS * 5 * numbers,
            bytes=4 * ADAM_FLOATS * 5 * numbers,
            run=lambda: adam_update_map(
                params, gradients, m, v, None, rates=rates, beta1=0.9, beta2=0.999, eps=1e-15
            ),
        ),
        Work(
            name="L1 and gradient",
            operations=("l1_mse_vjp",),
            flops=L1_FLOPS * 3 * pixels,
            bytes=4 * L1_FLOATS * 3 * pixels,
            run=lambda: l1_mse_vjp(image, target),
        ),
        Work(
            name="D-SSIM and gradient",
            operations=("dssim_vjp",),
            flops=SSIM_FLOPS * 3 * pixels,
            bytes=4 * 3 * 3 * pixels,
            run=lambda: dssim_vjp(image, target),
        ),
        Work(
            name="render",
            operations=("render_forward",),
            flops=FORWARD_FLOPS * pairs,
            bytes=4 * (numbers + 5 * pixels),
            run=forward,
        ),
        Work(
            name="render, gradient",
            operations=("render_forward", "render_vjp"),
            flops=BACKWARD_FLOPS * pairs,
            bytes=4 * (2 * numbers + 8 * pixels),
            run=backward,
        ),
        Work(
            name="TSDF update",
            operations=("fuse_frame_",),
            flops=TSDF_FLOPS * voxels,
            bytes=4 * (TSDF_FLOATS * voxels + 4 * pixels),
            run=lambda: fuse_frame_(volume()[0], frame),
        ),
    ]
