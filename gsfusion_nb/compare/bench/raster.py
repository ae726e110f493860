"""Random scenes through the rasteriser, beside gsplat on a GPU."""

import functools
import importlib
from collections.abc import Iterator

import torch
from torch import Tensor

from ...backends import use_backend
from ...evaluation.image import psnr
from ...geometry import se3
from ...render import render_forward, render_vjp
from ...render.constants import NEAR_PLANE_M, SCREEN_BLUR_PX2
from ...types import GaussianParams
from .options import DEVICES, BenchOptions, BenchRow, our_backends
from .scene import RandomScene, random_scene
from .timing import measure

COUNTS = (5_000, 20_000, 100_000)
SIZES = ((320, 240), (640, 480))
SH_DEGREES = (0, 3)
ON_A_GPU = (200_000, 1200, 680, 3, "cuda")
"""Gaussians, width, height, degree and device of the case that only runs on a GPU."""
GSPLAT = "gsplat (CUDA)"
"""Its rasteriser is timed beside ours in that case, where it is installed."""


def raster_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """Random scenes, forward, and forward with the gradient of every parameter; on a GPU one large
    scene more, beside gsplat; the note is the PSNR of its picture against ours."""
    counts, sizes, degrees = (
        (COUNTS[:2], SIZES[:1], (3,)) if options.quick else (COUNTS, SIZES, SH_DEGREES)
    )
    cases = [(n, *size, degree, "cpu") for degree in degrees for size in sizes for n in counts]
    if torch.cuda.is_available():
        cases.append(ON_A_GPU)
    for n, width, height, degree, device in cases:
        scene = random_scene(n, width, height, sh_degree=degree)
        for with_gradient in (False, True):
            title = (
                f"{n / 1000:g}k {width}x{height} SH{degree} {'fwd+bwd' if with_gradient else 'fwd'}"
            )
            ours = our_backends(options, "render_forward", "render_vjp")
            methods = [b for b in ours if device == "cpu" or DEVICES[b] == "cuda"]
            if device == "cuda" and has_gsplat():
                methods.append(GSPLAT)
            for method in methods:
                device_name = DEVICES.get(method, "cuda")
                own_scene = scene.to(device_name)
                draw = by_gsplat if method == GSPLAT else functools.partial(_draw, method)
                timing = measure(
                    lambda d=draw, s=own_scene, v=with_gradient: d(s, v),
                    options.budget_s,
                    device_name,
                )
                note = (
                    f"{psnr(draw(own_scene, False), _draw(methods[0], own_scene, False)):.0f} dB"
                    if method == GSPLAT
                    else ""
                )
                yield BenchRow(
                    section="raster", case=title, method=method, timing=timing, note=note
                )


def _draw(backend: str, scene: RandomScene, with_gradient: bool) -> Tensor:
    with use_backend(backend):
        output, context = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        if with_gradient:
            render_vjp(context, scene.v_rgb)
        return output.rgb


def has_gsplat() -> bool:
    """Whether gsplat is installed with its CUDA kernels, which it compiles with nvcc on first
    use."""
    try:
        return importlib.import_module("gsplat.cuda._backend")._C is not None
    except (ImportError, RuntimeError, OSError):
        return False


def by_gsplat(scene: RandomScene, with_gradient: bool) -> Tensor:
    """The picture that gsplat draws and, ``with_gradient``, dL/d of every parameter by its
    autograd."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    p = GaussianParams(
        **{name: x.detach().requires_grad_(with_gradient) for name, x in vars(scene.params).items()}
    )
    pictures, _, _ = rasterization(
        means=p.xyz_W,
        quats=p.quat,
        scales=p.log_scale.exp(),
        opacities=p.opacity_logit.sigmoid(),
        colors=p.sh,
        viewmats=se3.inverse(scene.T_WC)[None],
        Ks=scene.camera.K.to(p.xyz_W)[None],
        width=scene.camera.width,
        height=scene.camera.height,
        near_plane=NEAR_PLANE_M,
        eps2d=SCREEN_BLUR_PX2,
        sh_degree=p.sh_degree,
        packed=False,
    )
    if with_gradient:
        torch.autograd.grad(pictures[0], list(vars(p).values()), scene.v_rgb)
    return pictures[0].detach()
