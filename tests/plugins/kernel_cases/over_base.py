"""Gaussians over a picture of the surface, blended without order, and the gradient.

Cases of ``render_over_base`` and its gradient: holes, hidden Gaussians, no weight of the base, and
every option.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.render import Base, render_over_base, render_over_base_vjp
from gsfusion_nb.render.constants import NEAR_PLANE_M

from . import Case, make_frame, make_params
from .rasterize import break_rows


def cases() -> Iterator[Case]:
    """Degrees, then options."""
    for degree in (0, 3):
        yield _case(f"SH {degree}", degree=degree)
    yield _case("a base of all weights", weights=True)
    yield _case("some rows, centres in the image", some_rows=True, with_centres=True)
    yield _case("a nearer near plane", degree=1, near_m=0.05)
    yield _case("rows with NaN, infinities and overflows", degree=1, broken=True)
    for n in (0, 1):
        yield _case(f"{n} Gaussians", n=n, weights=True)


def _case(name: str, **options) -> Case:
    run = functools.partial(_run, **options)
    # a pair within rounding of the 1/255 cut may fall on either side
    operations = ("render_over_base", "render_over_base_vjp")
    return Case(name=name, operations=operations, run=run, tolerance=2e-5, flips=2e-3)


def _run(
    device: torch.device,
    dtype: torch.dtype,
    *,
    degree: int = 0,
    n: int = 50,
    weights: bool = False,
    some_rows: bool = False,
    broken: bool = False,
    with_centres: bool = False,
    near_m: float = NEAR_PLANE_M,
) -> dict[str, Tensor]:
    """``weights``: of the base, from 0 to 1; 1 else. ``broken``: some rows must not be drawn. With
    another ``near_m`` every fifth row is between it and the published one."""
    params = make_params(degree, device, dtype, n)
    frame = make_frame(device)
    if near_m != NEAR_PLANE_M:
        params.xyz_W[::5] *= 0.08  # of rows 1.5 m away and more
    if broken:
        break_rows(params)
    g = torch.Generator().manual_seed(1)
    size = (frame.camera.height, frame.camera.width)
    weight = (2 * torch.rand(size, generator=g) - 1).clamp_min(0) if weights else torch.ones(size)
    depth_m = (frame.depth_m + 0.5).to(dtype)
    depth_m[:10, :20] = 0.0
    rgb = make_frame().rgb.to(device, dtype)  # a GPU divides bytes by 255 with other rounding
    base = Base(rgb=rgb, depth_m=depth_m, weight=weight.to(device, dtype))
    v_rgb = torch.randn(*size, 3, generator=g).to(device, dtype)
    rows = (torch.rand(n, generator=g) < 0.5).to(device)
    view = (frame.camera, frame.T_WC)
    out, saved = render_over_base(params, *view, base, behind_m=0.1, near_m=near_m)
    names = ("v_uv", "v_uv_abs") if with_centres else ()
    centres = {name: torch.full((n, 2), torch.nan, dtype=dtype, device=device) for name in names}
    gradient = render_over_base_vjp(saved, v_rgb, rows=rows if some_rows else None, **centres)
    return vars(out) | {f"v_{name}": value for name, value in vars(gradient).items()} | centres
