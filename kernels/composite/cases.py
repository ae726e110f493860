"""Front-to-back blending of each tile's Gaussians and its gradient, a stage of rasterize.

Cases of ``composite`` and ``composite_vjp``: thin, opaque and tiny Gaussians, some pixels, and empty lists.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import composite, composite_vjp, project_gaussians, tile_intersections
from gsfusion_nb.types import GaussianParams

from ..runtime.cases import HEIGHT, WIDTH, Case, make_frame, make_params


def cases() -> Iterator[Case]:
    """Pixels that stop early, alpha clamped at 0.99, tiles with long lists and with none."""
    yield _case("usual")
    yield _case("thin", opacity_logit=-3.0)
    yield _case("opaque and large", opacity_logit=6.0, log_scale=1.0)
    yield _case("tiny", log_scale=-2.0)
    yield _case("some pixels", masked=True)
    yield _case("without indices and hits", with_indices=False, opaque_alpha=None)
    for n in (0, 1, 400):
        yield _case(f"{n} Gaussians", n=n)


def _case(name: str, **options) -> Case:
    run = functools.partial(_run, **options)
    return Case(name=name, operations=("composite", "composite_vjp"), run=run, tolerance=2e-5, flips=2e-3)


def _run(
    device: torch.device,
    dtype: torch.dtype,
    *,
    n: int = 50,
    masked: bool = False,
    opacity_logit: float = 0.0,
    log_scale: float = 0.0,
    with_indices: bool = True,
    opaque_alpha: float | None = 0.4,
) -> dict[str, Tensor]:
    """``opacity_logit`` and ``log_scale`` are added to those of every Gaussian."""
    p, frame = make_params(1, device, dtype, n), make_frame(device)
    moved = {"opacity_logit": p.opacity_logit + opacity_logit, "log_scale": p.log_scale + log_scale}
    p, T_WC = GaussianParams(**{**vars(p), **moved}), frame.T_WC.to(dtype)
    g = torch.Generator().manual_seed(1)
    v = [torch.randn(HEIGHT, WIDTH, *size, generator=g).to(device, dtype) for size in ((3,), (), ())]
    pixels = (torch.rand(HEIGHT, WIDTH, generator=g) < 0.3).to(device) if masked else None
    s, rgb = project_gaussians(p, frame.camera, T_WC), sh_to_rgb(p.sh, p.xyz_W, T_WC[:3, 3])
    tiles = tile_intersections(s, frame.camera, pixels=pixels)
    options = {"with_indices": with_indices, "opaque_alpha": opaque_alpha}
    out = composite(s.uv, s.conic, s.opacity, rgb, s.depth_m, tiles, frame.camera, **options)
    gradient = composite_vjp(out.saved, *v, with_uv_abs=True)
    images = {name: image for name, image in vars(out).items() if isinstance(image, Tensor)}
    return images | {f"v_{name}": value for name, value in vars(gradient).items()}
