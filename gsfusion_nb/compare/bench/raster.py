"""Cases of the rasteriser: a random scene, forward, and forward with the gradient of every parameter."""

import functools
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from ...backends import use_backend
from ...render import render_forward, render_vjp
from ...types import GaussianParams
from .cases import DEVICES, BenchCase, BenchOptions, BenchRow, our_backends
from .scene import RandomScene, random_scene
from .timing import measure

COUNTS = (5_000, 20_000, 100_000)
SIZES = ((320, 240), (640, 480))
SH_DEGREES = (0, 3)
ON_A_GPU = (200_000, 1200, 680, 3)
"""Gaussians, width, height and degree of the case that only runs on a GPU."""

BASELINE = "reference"
"""Backend that pictures and gradients are compared with."""

Result = tuple[Tensor, GaussianParams | None]
"""Picture and gradients."""


def cases(options: BenchOptions) -> Iterator[BenchCase]:
    """Our backends for every scene and direction; on a GPU one large scene more."""
    counts, sizes, degrees = (COUNTS[:2], SIZES[:1], (3,)) if options.quick else (COUNTS, SIZES, SH_DEGREES)
    for degree in degrees:
        for width, height in sizes:
            for n in counts:
                yield from _cases_of(options, (n, width, height, degree), "cpu")
    if torch.cuda.is_available():
        yield from _cases_of(options, ON_A_GPU, "cuda")


def _cases_of(options: BenchOptions, size: tuple[int, int, int, int], device: str) -> Iterator[BenchCase]:
    n, width, height, degree = size
    scene = functools.lru_cache(1)(lambda: random_scene(n, width, height, sh_degree=degree))
    found = our_backends(options, "render_forward", "render_vjp")
    methods = [b for b in found if device == "cpu" or DEVICES[b] == "cuda"]
    for backward in (False, True):
        title = f"{n / 1000:g}k {width}x{height} SH{degree} {'fwd+bwd' if backward else 'fwd'}"
        truth = functools.lru_cache(1)(lambda backward=backward: draw(BASELINE, scene().to(device), backward))
        for method in methods:
            run = functools.partial(_rows, options, method, scene, title, backward, truth)
            yield BenchCase(section="raster", title=title, run=run)


def _rows(
    options: BenchOptions,
    method: str,
    scene: Callable[[], RandomScene],
    title: str,
    backward: bool,
    truth: Callable[[], Result],
) -> list[BenchRow]:
    device = DEVICES[method]
    here = scene().to(device)
    timing = measure(lambda: draw(method, here, backward), budget_s=options.budget_s, device=device)
    note, values = ("", {}) if method == BASELINE else compare_to_baseline(draw(method, here, backward), truth())
    return [BenchRow(section="raster", case=title, method=method, timing=timing, note=note, values=values)]


def draw(backend: str, scene: RandomScene, backward: bool) -> Result:
    """The picture of a backend and, with ``backward``, dL/d of every parameter."""
    with use_backend(backend):
        output, saved = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        return output.rgb, render_vjp(saved, scene.v_rgb) if backward else None


def compare_to_baseline(result: Result, truth: Result) -> tuple[str, dict[str, float]]:
    """How close picture and gradients are to those of ``BASELINE``: PSNR, and the smallest cosine of a parameter."""
    mse = float((result[0].cpu() - truth[0].cpu()).double().square().mean())
    psnr_db = 200.0 if mse < 1e-20 else float(-10 * torch.log10(torch.tensor(mse)))
    values = {"psnr_to_reference_db": psnr_db}
    note = f"{psnr_db:.0f} dB"
    if result[1] is not None and truth[1] is not None:
        pairs = zip(vars(result[1]).values(), vars(truth[1]).values(), strict=True)
        found = ((a.cpu().double(), b.cpu().double()) for a, b in pairs)
        values["least_gradient_cosine"] = min(float((a * b).sum() / (a.norm() * b.norm())) for a, b in found)
        note += f" {values['least_gradient_cosine']:.4f}"
    return note, values
