"""Cases of whole mappers: time per frame, split into stages, and what keeping a run safe costs."""

import functools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...backends import use_backend
from ...config import gsfusion
from ...export import Saved
from ...mapping import SYSTEMS, GSFusion, get_system
from ...runs import CheckpointEvery, MappingRun
from ...runs.run_folder import StopRequest
from ...work import PeakMemory
from .cases import DEVICES, BenchCase, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import Lap, Timing, summary

STAGES = {
    "read": "read", "tsdf": "TSDF", "quadtree": "quadtree", "seeding": "seeding", "optimise": "optimisation",
}  # fmt: skip
"""Stage of the step's report -> its name in the table."""


def map_cases(options: BenchOptions) -> Iterator[BenchCase]:
    """The torch backend, then the fastest backend of each operation, on the CPU and on a GPU, for every image size."""
    backends = our_backends(options, "render_forward", "render_vjp")
    methods = [(b, b, "cpu") for b in ("reference", "torch") if b in backends]
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


EVERY_S = CheckpointEvery().seconds
"""Time between two checkpoints of a run; the cost of one is given as a share of it."""
WITHIN_STEP_S = 0.01
"""SIGTERM comes this long after the last frame but one was mapped: in the middle of the next step."""


def checkpoint_cases(options: BenchOptions) -> Iterator[BenchCase]:
    """All systems, for every image size."""
    for size in options.sizes:
        for system in SYSTEMS:
            run = functools.partial(_checkpoint_rows, options, size, system)
            yield BenchCase(section="checkpoints", title=f"{options.data}, {system}", run=run)


def _checkpoint_rows(options: BenchOptions, size: tuple[int, int], system: str) -> list[BenchRow]:
    """Map the frames and save a checkpoint after half of them; measured is the one that SIGTERM at the end asks for."""
    frames = open_frames(options, size)
    for i in range(len(frames)):
        frames[i]  # images of the room are rendered once and kept
    mapper = get_system(system)(get_system(system).preset("room" if options.data == "room" else "replica"))
    run = MappingRun(frames, mapper, source={"path_or_name": options.data})
    with tempfile.TemporaryDirectory() as folder:
        saved, cost, after_s = _stop(run, Path(folder), len(frames))
    share = cost.cpu_s / EVERY_S
    values = {
        "frames": len(run.steps),
        "n_gaussians": len(mapper.gaussians),
        "checkpoint_mb": saved.total_bytes / 1e6,
        "written_mb": saved.written_bytes / 1e6,
        "share_of_time": share,
    }
    case = f"{case_name(frames)} {system}"
    note = f"{100 * share:.1f} %, {values['checkpoint_mb']:.0f} MB"
    rows = [_checkpoint_row(case, "a checkpoint", cost, note, values)]
    if after_s is not None:
        n = f"{len(mapper.gaussians) / 1e3:.1f}k Gaussians"
        rows.append(_checkpoint_row(case, "SIGTERM to saved", Lap(after_s, 0.0), n, {"after_sigterm_s": after_s}))
    return rows


def _checkpoint_row(case: str, method: str, took: Lap, note: str, values: dict[str, Any]) -> BenchRow:
    return BenchRow(section="checkpoints", case=case, method=method, timing=summary([took]), note=note, values=values)


def _stop(run: MappingRun, folder: Path, n: int) -> tuple[Saved, Lap, float | None]:
    """Stop a run in its ``n``-th step as SIGTERM does.

    Returns:
        The checkpoint, what it took, and the time from the signal until it was on disk, the rest of the step included,
        seconds. None outside the main thread, where no signal arrives.
    """
    stop, sent = StopRequest(), []
    run.mapper.guard.stop_wanted = lambda: bool(stop)

    def send() -> None:
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGTERM)

    timer = threading.Timer(WITHIN_STEP_S, send)
    with stop.listening():
        for step, _ in enumerate(run.online(), start=1):
            if step == n // 2:
                run.save_checkpoint(folder)
            if step == n - 1 and threading.current_thread() is threading.main_thread():
                timer.start()
            if stop:
                break
        if timer.ident is not None:
            timer.join()
        wall, cpu = time.perf_counter(), time.process_time()
        with stop.held_back():
            saved = run.save_checkpoint(folder)
        end = time.perf_counter()
    return saved, Lap(end - wall, time.process_time() - cpu), end - sent[0] if sent else None
