"""Cases of the rasteriser: a random scene, forward, and forward with the gradient of every parameter."""

import functools
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from ... import backends
from ...backends import use_backend
from ...render import render_forward, render_vjp
from ...types import GaussianParams
from ...work import available_memory
from . import gsplat_cuda, gsplat_torch
from .options import BenchOptions
from .other_programs import OTHER_PROGRAMS, why_not
from .rows import Case, Row
from .scene import RandomScene, random_scene
from .timing import measure

COUNTS = (5_000, 20_000, 100_000)
SIZES = ((320, 240), (640, 480))
SH_DEGREES = (0, 3)
ON_A_GPU = (200_000, 1200, 680, 3)
"""Gaussians, width, height and degree of the case that only runs on a GPU."""

DEVICES = {"reference": "cpu", "torch": "cpu", "numba": "cpu", "triton": "cuda", "cuda": "cuda"}
"""Device of each backend."""

BASELINE = "torch"
"""Backend that pictures and gradients are compared with. (Tests compare it with the reference, which is several times
slower.)"""

Result = tuple[Tensor, GaussianParams | None]
"""Picture and gradients."""


def cases(options: BenchOptions) -> Iterator[Case]:
    """Other programs first, then our backends, for every scene and direction."""
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


def _cases_of(options: BenchOptions, scene: Callable[[], RandomScene], name: str, backward: bool) -> Iterator[Case]:
    title = f"{name} {'fwd+bwd' if backward else 'fwd'}"
    truth = functools.lru_cache(1)(lambda: _ours(BASELINE, scene(), backward))
    if why_not("gsplat") is None:
        run = functools.partial(_gsplat_row, options, "gsplat", scene, title, backward, truth)
        yield Case(section="raster", title=title, run=lambda run=run: [run()])
    for backend in our_backends(options, "render_forward", "render_vjp"):
        run = functools.partial(_our_row, options, backend, scene, title, backward, truth)
        yield Case(section="raster", title=title, run=lambda run=run: [run()])


def _gpu_cases_of(options: BenchOptions, scene: Callable[[], RandomScene], name: str, backward: bool) -> Iterator[Case]:
    """Like ``_cases_of``, all on the GPU, gsplat's CUDA path first."""
    title = f"{name} {'fwd+bwd' if backward else 'fwd'}"
    truth = functools.lru_cache(1)(lambda: _to_cpu(_ours(BASELINE, scene().to("cuda"), backward)))
    if why_not("gsplat_cuda") is None:
        run = functools.partial(_gsplat_row, options, "gsplat_cuda", scene, title, backward, truth)
        yield Case(section="raster", title=title, run=lambda run=run: [run()])
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
    """The requested backends that can run all of ``operations`` on this machine, slow ones first.

    The reference is written for reading: it is timed only if the options name it.
    """
    working = {(name, backend) for name, backend, state in backends.report() if state == "ok"}
    usable = [b for b in backends.BACKENDS if b == "torch" or all((name, b) in working for name in operations)]
    asked = [b for b in usable if b in options.backend or (not options.backend and b != "reference")]
    return [b for b in asked if DEVICES[b] == "cpu" or torch.cuda.is_available()]


def _ours(backend: str, scene: RandomScene, backward: bool) -> Result:
    with use_backend(backend):
        output, saved = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        return output.rgb, render_vjp(saved, scene.v_rgb) if backward else None


def _our_row(
    options: BenchOptions,
    backend: str,
    scene: Callable[[], RandomScene],
    title: str,
    backward: bool,
    truth: Callable[[], Result],
) -> Row:
    device = DEVICES[backend]
    here = scene().to(device)
    timing = measure(lambda: _ours(backend, here, backward), budget_s=options.budget_s, device=device)
    note, values = ("", {}) if backend == BASELINE else compare_to_baseline(_ours(backend, here, backward), truth())
    return Row(section="raster", case=title, method=backend, timing=timing, note=note, values=values)


def _gsplat_row(
    options: BenchOptions,
    program: str,
    scene: Callable[[], RandomScene],
    title: str,
    backward: bool,
    truth: Callable[[], Result],
) -> Row:
    """``program``: "gsplat", its torch path on the CPU, or "gsplat_cuda"."""
    row = functools.partial(Row, section="raster", case=title, method=OTHER_PROGRAMS[program].name)
    path, device = (gsplat_torch, "cpu") if program == "gsplat" else (gsplat_cuda, "cuda")
    here = scene().to(device)
    if program == "gsplat":
        needed = gsplat_torch.BYTES_PER_PIXEL * here.camera.width * here.camera.height
        free = available_memory(torch.device("cpu"))
        if free is not None and free < needed:
            return row(note=f"needs about {needed / 1e9:.1f} GB, {free / 1e9:.1f} free")
    last: list[Result] = []

    def work() -> None:
        last[:] = [by_autograd(path.render, here, backward)]

    least_runs = 1 if options.quick and program == "gsplat" else 3
    timing = measure(work, budget_s=options.budget_s, least_runs=least_runs, device=device)
    note, values = compare_to_baseline(last[0], truth())
    return row(timing=timing, note=note, values=values)


def by_autograd(render: Callable[[GaussianParams, RandomScene], Tensor], scene: RandomScene, backward: bool) -> Result:
    """The picture of another renderer and, with ``backward``, dL/d of every parameter by autograd."""
    if not backward:
        with torch.no_grad():
            return render(scene.params, scene), None
    leaves = {name: value.detach().requires_grad_() for name, value in vars(scene.params).items()}
    rgb = render(GaussianParams(**leaves), scene)
    gradients = torch.autograd.grad(rgb, list(leaves.values()), scene.v_rgb)
    return rgb.detach(), GaussianParams(**dict(zip(leaves, gradients, strict=True)))


def compare_to_baseline(result: Result, truth: Result) -> tuple[str, dict[str, float]]:
    """How close picture and gradients are to those of ``BASELINE``: PSNR, and the smallest cosine of a parameter."""
    mse = float((result[0].cpu() - truth[0]).double().square().mean())
    psnr_db = 200.0 if mse < 1e-20 else float(-10 * torch.log10(torch.tensor(mse)))
    values = {"psnr_to_torch_db": psnr_db}
    note = f"{psnr_db:.0f} dB"
    if result[1] is not None and truth[1] is not None:
        pairs = ((a.cpu().double(), b.double()) for a, b in _pairs(result[1], truth[1]))
        values["least_gradient_cosine"] = min(float((a * b).sum() / (a.norm() * b.norm())) for a, b in pairs)
        note += f" {values['least_gradient_cosine']:.4f}"
    return note, values


def _pairs(a: GaussianParams, b: GaussianParams) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(vars(a).values(), vars(b).values(), strict=True)
