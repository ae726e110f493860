"""The whole mapper, by stage."""

import time
from collections.abc import Iterator

from ...backends import use_backend
from ...config import gsfusion
from ...data import OpenedSequence
from ...mapping import GSFusion
from ...resources import PeakMemory
from .options import DEVICES, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import Timing

STAGES = {
    "read": "read",
    "tsdf": "TSDF",
    "quadtree": "quadtree",
    "seeding": "seeding",
    "optimise": "optimisation",
}
"""Stage of the step's report -> its name in the table."""


def map_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """The whole mapper by stage: the reference, if it is asked for, then the fastest backend of
    each operation.

    On a GPU the time of a stage ends when its work is queued; the time of the whole step includes
    its execution.
    """
    names = our_backends(options, "render_forward", "render_vjp")
    methods = [(b, b, "cpu") for b in names if b == "reference"]
    methods += [(f"auto ({b})", "auto", DEVICES[b]) for b in ("numba", "cuda") if b in names]
    for size in options.sizes:
        for method, backend, device in methods:
            with use_backend(backend):
                yield from _mapper_rows(open_frames(options, size), method, device)


def _mapper_rows(frames: OpenedSequence, method: str, device: str) -> Iterator[BenchRow]:
    config = gsfusion("online")
    n = len(frames)
    # compiles, and renders the first image of the room
    GSFusion(config, device=device).step(frames[0])
    for i in range(n):
        frames[i]  # images of the room are rendered once and kept
    seconds = dict.fromkeys(STAGES, 0.0)
    cpu_s = 0.0
    with PeakMemory(device) as memory:
        mapper = GSFusion(config, device=device)
        for i in range(n):
            start = time.perf_counter()
            frame = frames[i]
            seconds["read"] += time.perf_counter() - start
            cpu = time.process_time()
            report = mapper.step(frame)
            cpu_s += time.process_time() - cpu
            for stage, took in report.seconds.items():
                seconds[stage] = seconds.get(stage, 0.0) + took
    step_s = sum(took for stage, took in seconds.items() if stage != "read")
    values = {"frames": n, "frames_per_second": n / step_s, "n_gaussians": len(mapper.gaussians)}
    case = case_name(frames)
    note = f"{n / step_s:.1f}/s, {len(mapper.gaussians) / 1e3:.1f}k"
    total = Timing(
        wall_ms=1e3 * step_s / n,
        cpu_ms=1e3 * cpu_s / n,
        runs=n,
        peak_mb=memory.peak_mb,
    )
    yield BenchRow(
        section="map",
        case=case,
        method=method,
        timing=total,
        note=note,
        values=values,
    )
    for stage, name in STAGES.items():
        each = Timing(
            wall_ms=1e3 * seconds[stage] / n,
            cpu_ms=0.0,
            runs=n,
            peak_mb=None,
        )
        share = "not counted" if stage == "read" else f"{100 * seconds[stage] / step_s:.0f} %"
        yield BenchRow(
            section="map", case=f"{case} / {name}", method=method, timing=each, note=share
        )
