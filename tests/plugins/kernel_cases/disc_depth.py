"""Depth of the first opaque disc at each pixel, and its gradient (RTG-SLAM).

Cases of ``disc_depth`` and ``disc_depth_vjp``: discs that are met, planes too steep or too far
away, no hits.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.render import disc_depth, disc_depth_vjp
from gsfusion_nb.types import GaussianParams

from . import HEIGHT, WIDTH, Case, make_frame, make_params


def cases() -> Iterator[Case]:
    """With and without the test of the offset; lenient angles; some rows; equal scales; one
    Gaussian and none."""
    yield _case("usual")
    yield _case("without the test of the offset", max_offset=None)
    yield _case("any angle", max_offset=None, min_cosine=0.05)
    yield _case("equal scales", equal_scales=True)
    yield _case("some rows", some_rows=True)
    for n in (0, 1):
        yield _case(f"{n} Gaussians", n=n, some_rows=True)


def _case(name: str, **options) -> Case:
    # an angle or an offset within rounding of its limit may fall on either side; a steep plane is
    # met far away
    operations = ("disc_depth", "disc_depth_vjp")
    return Case(
        name=name,
        operations=operations,
        run=functools.partial(_run, **options),
        tolerance=5e-5,
        flips=2e-3,
    )


def _run(
    device: torch.device,
    dtype: torch.dtype,
    *,
    n: int = 50,
    some_rows: bool = False,
    equal_scales: bool = False,
    **options,
) -> dict[str, Tensor]:
    """Every pixel hits a Gaussian at random, or none: far from the disc the offset is tested,
    too."""
    params = make_params(0, device, dtype, n)
    frame = make_frame(device)
    log_scale = params.log_scale + 2.0
    if equal_scales:
        log_scale = log_scale[:, :1].expand(n, 3)
    params = GaussianParams(**{**vars(params), "log_scale": log_scale})
    g = torch.Generator().manual_seed(1)
    hit_index = torch.randint(
        -1,
        max(n, 1),
        (HEIGHT, WIDTH),
        generator=g,
    ).to(device)
    hit_index = torch.where(hit_index < n, hit_index, -1)
    v = torch.randn(HEIGHT, WIDTH, generator=g).to(device, dtype)
    rows = (torch.rand(n, generator=g) < 0.5).to(device) if some_rows else None
    disc = disc_depth(params, frame.camera, frame.T_WC, hit_index, **options)
    v_xyz_W, v_quat = disc_depth_vjp(
        params, frame.camera, frame.T_WC, hit_index, v, rows=rows, **options
    )
    return vars(disc) | {"v_xyz_W": v_xyz_W, "v_quat": v_quat}
