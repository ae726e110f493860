"""Cases of whole mappers: time per frame, split into stages."""

import functools
import time
from collections.abc import Iterator

from ...backends import use_backend
from ...config import gsfusion
from ...mapping import GSFusion
from ...work import PeakMemory
from .cases import DEVICES, BenchCase, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import Timing

STAGES = {
    "read": "read", "tsdf": "TSDF", "quadtree": "quadtree", "seeding": "seeding", "optimise": "optimisation",
}  # fmt: skip
"""Stage of the step's report -> its name in the table."""


def map_cases(options: BenchOptions) -> Iterator[BenchCase]:
    """For every image size the reference, if it is asked for, then the fastest backend of each operation."""
    backends = our_backends(options, "render_forward", "render_vjp")
    methods = [(b, b, "cpu") for b in backends if b == "reference"]
    methods += [(f"auto ({b})", "auto", DEVICES[b]) for b in ("numba", "cuda") if b in backends]
    for size in options.sizes:
        for method, backend, device in methods:
            run = functools.partial(_map_rows, options, size, method, backend, device)
            yield BenchCase(section="map", title=f"{options.data}, {method}", run=run)


def _map_rows(options: BenchOptions, size: tuple[int, int], method: str, backend: str, device: str) -> list[BenchRow]:
    """On a GPU the time of a stage ends when its work is queued; the time of the whole step includes its execution."""
    frames = open_frames(options, size)
    config = gsfusion("online")
    with use_backend(backend):
        GSFusion(config, device=device).step(frames[0])  # compiles, and renders the first image of the room
        for i in range(len(frames)):
            frames[i]  # images of the room are rendered once and kept
        with PeakMemory(device) as memory:
            mapper = GSFusion(config, device=device)
            seconds = dict.fromkeys(STAGES, 0.0)
            cpu_s, psnr = 0.0, []
            for i in range(len(frames)):
                start = time.perf_counter()
                frame = frames[i]
                seconds["read"] += time.perf_counter() - start
                cpu = time.process_time()
                report = mapper.step(frame)
                cpu_s += time.process_time() - cpu
                for stage, took in report.seconds.items():
                    seconds[stage] = seconds.get(stage, 0.0) + took
                psnr.append(report.psnr_after_db)
    n = len(frames)
    step_s = sum(took for stage, took in seconds.items() if stage != "read")
    values = {
        "frames": n,
        "frames_per_second": n / step_s,
        "frames_per_second_with_reading": n / (step_s + seconds["read"]),
        "n_gaussians": len(mapper.gaussians),
        "n_blocks": mapper.volume.n_blocks,
        "mean_psnr_of_current_view_db": sum(psnr) / n,
        "sh_degree": config.sh_degree,
    }
    case = case_name(frames)
    total = Timing(wall_ms=1e3 * step_s / n, cpu_ms=1e3 * cpu_s / n, runs=n, peak_mb=memory.peak_mb)
    note = f"{n / step_s:.1f}/s, {len(mapper.gaussians) / 1e3:.1f}k"
    rows = [BenchRow(section="map", case=case, method=method, timing=total, note=note, values=values)]
    for stage, name in STAGES.items():
        each = Timing(wall_ms=1e3 * seconds[stage] / n, cpu_ms=0.0, runs=n, peak_mb=None)
        share = "not counted" if stage == "read" else f"{100 * seconds[stage] / step_s:.0f} %"
        rows.append(BenchRow(section="map", case=f"{case} / {name}", method=method, timing=each, note=share))
    return rows
