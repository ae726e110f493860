"""Picture of a Gaussian map and its gradient.

Cases of ``render_forward`` and ``render_vjp``: every degree and option, and maps of no, one and
fifty Gaussians.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import GaussianParams

from . import HEIGHT, WIDTH, Case, make_frame, make_params

OPAQUE = 0.3


def cases() -> Iterator[Case]:
    """Each option alone, and together."""
    for degree in range(4):
        yield _case(f"SH {degree}", degree=degree)
    for degree in (0, 3):
        yield _case(f"SH {degree}, without indices", degree=degree, with_indices=False)
    for degree in (0, 3):
        yield _case(
            f"SH {degree}, gradient of colour only", degree=degree, with_indices=False, gradients=1
        )
    yield _case("gradients of colour and depth", gradients=2)
    yield _case("hits", opaque_alpha=OPAQUE)
    yield _case("hits, without indices", opaque_alpha=OPAQUE, with_indices=False)
    yield _case("centres in the image", with_centres=True)
    yield _case(
        "centres in the image, some pixels and rows", with_centres=True, masked=True, some_rows=True
    )
    yield _case("a near and a far plane", with_centres=True, near_m=1.8, far_m=2.2)
    yield _case("a near plane behind the usual one", close=True, with_centres=True, near_m=0.01)
    yield _case("some pixels", masked=True)
    yield _case("some rows", some_rows=True)
    yield _case(
        "some pixels and rows, hits", degree=3, masked=True, some_rows=True, opaque_alpha=OPAQUE
    )
    yield _case(
        "rows with NaN, infinities and overflows",
        degree=1,
        broken=True,
        with_centres=True,
        opaque_alpha=OPAQUE,
    )
    for n in (0, 1):
        yield _case(
            f"{n} Gaussians",
            n=n,
            masked=True,
            some_rows=True,
            with_centres=True,
            opaque_alpha=OPAQUE,
        )


def _case(name: str, **options) -> Case:
    # a pair within rounding of the 1/255 cut or of the 1e-4 stop may fall on either side
    run = functools.partial(_run, **options)
    return Case(
        name=name, operations=("render_forward", "render_vjp"), run=run, tolerance=2e-5, flips=2e-3
    )


def _run(
    device: torch.device,
    dtype: torch.dtype,
    *,
    degree: int = 0,
    n: int = 50,
    masked: bool = False,
    some_rows: bool = False,
    gradients: int = 3,
    broken: bool = False,
    with_centres: bool = False,
    close: bool = False,
    **options,
) -> dict[str, Tensor]:
    """``gradients``: how many of colour, depth and alpha have one. ``broken``: some rows must not
    be drawn. ``with_centres``: also the gradient of the centres in the image, the sum of its
    absolute values, and the gradient of the conics. ``close``: a map a tenth as large, as near."""
    params = make_params(degree, device, dtype, n)
    frame = make_frame(device)
    if close:
        params = dataclasses.replace(
            params, xyz_W=params.xyz_W / 10, log_scale=params.log_scale - math.log(10)
        )
    if broken:
        break_rows(params)
    g = torch.Generator().manual_seed(1)
    v = [
        torch.randn(HEIGHT, WIDTH, *size, generator=g).to(device, dtype) for size in ((3,), (), ())
    ]
    pixels = torch.rand(HEIGHT, WIDTH, generator=g) < 0.3
    pixels[: HEIGHT // 2, : WIDTH // 2] = False  # and whole tiles without any
    pixels = pixels.to(device)
    rows = (torch.rand(n, generator=g) < 0.5).to(device)
    out, saved = render_forward(
        params, frame.camera, frame.T_WC, pixels=pixels if masked else None, **options
    )
    widths = {"v_uv": 2, "v_uv_abs": 2, "v_conic": 3} if with_centres else {}
    centres = {
        name: torch.full((n, width), torch.nan, dtype=dtype, device=device)
        for name, width in widths.items()
    }
    gradient = render_vjp(saved, *v[:gradients], rows=rows if some_rows else None, **centres)
    results = {name: image for name, image in vars(out).items() if image is not None}
    results |= {f"v_{name}": value for name, value in vars(gradient).items()}
    return results | centres


def break_rows(params: GaussianParams) -> int:
    """Spoil the first rows in place, each in another way; returns how many."""
    nan = float("nan")
    inf = float("inf")
    spoilt = (
        [("xyz_W", value) for value in (nan, inf, -inf)]
        + [("log_scale", value) for value in (nan, inf, 50.0)]
        + [("quat", value) for value in (nan, inf)]
        + [("opacity_logit", value) for value in (nan, -inf)]
        + [("sh", value) for value in (nan, inf, -inf)]
    )
    for row, (name, value) in enumerate(spoilt):
        column = getattr(params, name)
        column.view(len(column), -1)[row, -1] = value
    return len(spoilt)
