"""Growth of time: the exponent p of time ~ x^p for Gaussians, pixels and voxels, from a line fitted in log-log axes."""

import functools
from collections.abc import Callable, Iterator

import numpy as np

from ...backends import use_backend
from ...render import render_forward, render_vjp
from .frames import StoredFrames, stored_frames
from .options import BenchOptions
from .other_tsdf_volumes import FusionSettings
from .raster import DEVICES, our_backends
from .rows import Case, Row
from .scene import random_scene
from .timing import Timing, measure, summary
from .tsdf import FAR_M, TRUNCATION_VOXELS, OurVolume, fuse_all

GAUSSIANS = (5_000, 10_000, 20_000, 40_000, 80_000)
GAUSSIANS_SIZE = (320, 240)
PIXELS = ((160, 120), (320, 240), (640, 480), (1280, 960))
PIXELS_GAUSSIANS = 20_000
VOXELS_M = (0.04, 0.028, 0.02, 0.014, 0.01)
VOXELS_FRAMES = 10

Point = tuple[float, float]
"""Size and milliseconds."""


def cases(options: BenchOptions) -> Iterator[Case]:
    """One case per axis and backend."""
    last = 3 if options.quick else None
    if "raster" in options.sections:
        sizes: list[tuple[int, int, int]] = [(n, *GAUSSIANS_SIZE) for n in GAUSSIANS[:last]]
        fixed = f"fwd+bwd {GAUSSIANS_SIZE[0]}x{GAUSSIANS_SIZE[1]} SH0"
        yield from _raster_cases(options, f"Gaussians, {fixed}", sizes, lambda n, w, h: float(n))
        sizes = [(PIXELS_GAUSSIANS, *size) for size in PIXELS[:last]]
        yield from _raster_cases(options, "pixels, fwd+bwd 20k SH0", sizes, lambda n, w, h: float(w * h))
    if "tsdf" in options.sections:
        load = functools.lru_cache(1)(functools.partial(stored_frames, options, options.sizes[0]))
        for backend in our_backends(options, "band_blocks", "fuse_frame_"):
            run = functools.partial(_voxels, options, backend, load, VOXELS_M[:last])
            yield Case(section="scaling", title="voxels observed a frame", run=lambda run=run: [run()])


def exponent(points: list[Point]) -> float:
    """Slope of the least-squares line through (ln x, ln time)."""
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def _raster_cases(
    options: BenchOptions, axis: str, sizes: list[tuple[int, int, int]], measure_of: Callable[[int, int, int], float]
) -> Iterator[Case]:
    for backend in our_backends(options, "render_forward", "render_vjp"):

        def run(backend: str = backend) -> list[Row]:
            times = [_raster_ms(options, backend, size) for size in sizes]
            return [_row(axis, backend, [(measure_of(*s), t) for s, t in zip(sizes, times, strict=True)])]

        yield Case(section="scaling", title=axis, run=run)


def _raster_ms(options: BenchOptions, backend: str, size: tuple[int, int, int]) -> float:
    device = DEVICES[backend]
    scene = random_scene(*size).to(device)

    def work() -> None:
        _, saved = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        render_vjp(saved, scene.v_rgb)

    with use_backend(backend):
        timing = measure(work, budget_s=options.budget_s / 2, device=device)
    return _ms(timing, options.threads if device == "cpu" else 0)


def _voxels(
    options: BenchOptions, backend: str, load: Callable[[], StoredFrames], voxel_sizes_m: tuple[float, ...]
) -> Row:
    frames = load()
    n = min(VOXELS_FRAMES, len(frames))
    points = []
    for voxel_m in voxel_sizes_m:
        settings = FusionSettings(voxel_size_m=voxel_m, truncation_voxels=TRUNCATION_VOXELS, far_m=FAR_M, threads=0)
        fuser = OurVolume(backend, settings)
        timing = summary(fuse_all(fuser, frames, n)[1:])
        points.append((fuser.updated_voxels / n, _ms(timing, options.threads)))
    return _row("voxels observed a frame", backend, points)


def _ms(timing: Timing, threads: int) -> float:
    return timing.cpu_ms if threads == 1 else timing.wall_ms


def _row(axis: str, backend: str, points: list[Point]) -> Row:
    p = exponent(points)
    (x0, t0), (x1, t1) = points[0], points[-1]
    note = f"time ~ x^{p:.2f}: {_short(x0)} {t0:.3g} ms ... {_short(x1)} {t1:.3g} ms"
    values = {"exponent": p, "points": [{"x": x, "ms": t} for x, t in points]}
    return Row(section="scaling", case=axis, method=backend, note=note, values=values)


def _short(x: float) -> str:
    return f"{x / 1e6:.3g}M" if x >= 1e6 else f"{x / 1e3:.3g}k"
