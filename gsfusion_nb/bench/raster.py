"""Cases of the rasteriser: a random scene, forward, and forward with the gradient of every parameter."""

import functools
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from .. import backends
from ..backends import use_backend
from ..render import render_forward, render_vjp
from ..tsdf.volume import available_memory
from ..types import GaussianParams
from . import gsplat_cuda, gsplat_torch
from .options import BenchOptions
from .peers import PEERS, why_not
from .rows import Case, Row
from .scene import Scene, random_scene
from .timing import measure

COUNTS = (5_000, 20_000, 100_000)
SIZES = ((320, 240), (640, 480))
SH_DEGREES = (0, 3)
ON_A_GPU = (200_000, 1200, 680, 3)
"""Gaussians, width, height and degree of the case that only a GPU is asked to run."""

DEVICES = {"reference": "cpu", "torch": "cpu", "numba": "cpu", "triton": "cuda", "cuda": "cuda"}
"""Where each backend computes."""

Result = tuple[Tensor, GaussianParams | None]
"""Picture and gradients."""


def cases(options: BenchOptions) -> Iterator[Case]:
    """Peers first, then the reference, then the fast backends, for every scene and direction."""
    counts, sizes, degrees = (COUNTS[:2], SIZES[:1], (3,)) if options.quick else (COUNTS, SIZES, SH_DEGREES)
    for degree in degrees:
        for width, height in sizes:
            for n in counts:
                scene = functools.lru_cache(1)(functools.partial(random_scene, n, width, height, sh_degree=degree))
                for backward in (False, True):
                    yield from _cases_of(options, scene, f"{n / 1000:g}k {width}x{height} SH{degree}", backward)
    if torch.cuda.is_available():
        n, width, height, degree = ON_A_GPU
        scene = functools.lru_cache(1)(functools.partial(random_scene, n, width, height, sh_degree=degree))
        for backward in (False, True):
            yield from _gpu_cases_of(options, scene, f"{n / 1000:g}k {width}x{height} SH{degree}", backward)


def _cases_of(options: BenchOptions, scene: Callable[[], Scene], name: str, backward: bool) -> Iterator[Case]:
    title = f"{name} {'fwd+bwd' if backward else 'fwd'}"
    truth = functools.lru_cache(1)(lambda: _ours("reference", scene(), backward))
    if why_not("gsplat") is None:
        yield Case(section="raster", title=title, run=lambda: [_gsplat_row(options, scene(), title, backward, truth())])
    for backend in our_backends(options, "render_forward", "render_vjp"):
        run = functools.partial(_our_row, options, backend, scene, title, backward, truth)
        yield Case(section="raster", title=title, run=lambda run=run: [run()])


def _gpu_cases_of(options: BenchOptions, scene: Callable[[], Scene], name: str, backward: bool) -> Iterator[Case]:
    """As ``_cases_of``, all on the GPU, gsplat's CUDA path first; the truth is the reference there."""
    title = f"{name} {'fwd+bwd' if backward else 'fwd'}"
    truth = functools.lru_cache(1)(lambda: _to_cpu(_ours("reference", scene().to("cuda"), backward)))
    if why_not("gsplat_cuda") is None:
        run = functools.partial(_gsplat_cuda_row, options, scene, title, backward, truth)
        yield Case(section="raster", title=title, run=lambda: [run()])
    for backend in our_backends(options, "render_forward", "render_vjp"):
        if DEVICES[backend] == "cuda":
            run = functools.partial(_our_row, options, backend, scene, title, backward, truth)
            yield Case(section="raster", title=title, run=lambda run=run: [run()])


def _to_cpu(result: Result) -> Result:
    rgb, gradients = result
    if gradients is not None:
        gradients = GaussianParams(**{name: value.cpu() for name, value in vars(gradients).items()})
    return rgb.cpu(), gradients


def our_backends(options: BenchOptions, *operations: str) -> list[str]:
    """Backends that can run all of ``operations`` on this machine and are asked for, the reference first."""
    working = {(name, backend) for name, backend, state in backends.report() if state == "ok"}
    usable = [b for b in backends.BACKENDS if all((name, b) in working for name in operations)]
    asked = [b for b in usable if not options.backend or b in options.backend]
    return [b for b in asked if DEVICES[b] == "cpu" or torch.cuda.is_available()]


def _ours(backend: str, scene: Scene, backward: bool) -> Result:
    with use_backend(backend):
        output, saved = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        return output.rgb, render_vjp(saved, scene.v_rgb) if backward else None


def _our_row(
    options: BenchOptions,
    backend: str,
    scene: Callable[[], Scene],
    title: str,
    backward: bool,
    truth: Callable[[], Result],
) -> Row:
    device = DEVICES[backend]
    here = scene().to(device)
    timing = measure(lambda: _ours(backend, here, backward), budget_s=options.budget_s, device=device)
    note, values = ("", {}) if backend == "reference" else agreement(_ours(backend, here, backward), truth())
    return Row(section="raster", case=title, method=backend, timing=timing, note=note, values=values)


def _gsplat_row(options: BenchOptions, scene: Scene, title: str, backward: bool, truth: Result) -> Row:
    row = functools.partial(Row, section="raster", case=title, method=PEERS["gsplat"].name)
    pixels = scene.camera.width * scene.camera.height
    free = available_memory(torch.device("cpu"))
    if free is not None and free < gsplat_torch.BYTES_PER_PIXEL * pixels:
        return row(note=f"needs about {gsplat_torch.BYTES_PER_PIXEL * pixels / 1e9:.1f} GB, {free / 1e9:.1f} free")

    last: list[Result] = []

    def work() -> None:
        last[:] = [gsplat_torch.forward_backward(scene) if backward else (gsplat_torch.forward(scene), None)]

    timing = measure(work, budget_s=options.budget_s, least_runs=1 if options.quick else 3)
    note, values = agreement(last[0], truth)
    return row(timing=timing, note=note, values=values)


def _gsplat_cuda_row(
    options: BenchOptions, scene: Callable[[], Scene], title: str, backward: bool, truth: Callable[[], Result]
) -> Row:
    here, last = scene().to("cuda"), []

    def work() -> None:
        last[:] = [gsplat_cuda.forward_backward(here) if backward else (gsplat_cuda.forward(here), None)]

    timing = measure(work, budget_s=options.budget_s, device="cuda")
    note, values = agreement(last[0], truth())
    return Row(
        section="raster", case=title, method=PEERS["gsplat_cuda"].name, timing=timing, note=note, values=values
    )  # fmt: skip


def agreement(result: Result, truth: Result) -> tuple[str, dict[str, float]]:
    """How close a picture and its gradients are to the reference's: PSNR, and the least cosine of any parameter."""
    mse = float((result[0].cpu() - truth[0]).double().square().mean())
    psnr_db = 200.0 if mse < 1e-20 else float(-10 * torch.log10(torch.tensor(mse)))
    values = {"psnr_to_reference_db": psnr_db}
    note = f"{psnr_db:.0f} dB"
    if result[1] is not None and truth[1] is not None:
        pairs = ((a.cpu().double(), b.double()) for a, b in _pairs(result[1], truth[1]))
        values["least_gradient_cosine"] = min(float((a * b).sum() / (a.norm() * b.norm())) for a, b in pairs)
        note += f" {values['least_gradient_cosine']:.4f}"
    return note, values


def _pairs(a: GaussianParams, b: GaussianParams) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(vars(a).values(), vars(b).values(), strict=True)
