"""Cases of what keeping a run safe costs: one checkpoint, and how soon after SIGTERM it is on disk."""

import functools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...export import Saved
from ...mapping import SYSTEMS, get_system
from ...runs import CheckpointEvery, MappingRun
from ...runs.stop_request import StopRequest
from .frames import case_name, open_frames
from .options import BenchOptions
from .rows import Case, Row
from .timing import Lap, summary

EVERY_S = CheckpointEvery().seconds
"""Time between two checkpoints of a run; the cost of one is given as a share of it."""
WITHIN_STEP_S = 0.01
"""SIGTERM comes this long after the last frame but one was mapped: in the middle of the next step."""


def cases(options: BenchOptions) -> Iterator[Case]:
    """All systems, for every image size."""
    for size in options.sizes:
        for system in SYSTEMS:
            run = functools.partial(_rows, options, size, system)
            yield Case(section="checkpoints", title=f"{options.data}, {system}", run=run)


def _rows(options: BenchOptions, size: tuple[int, int], system: str) -> list[Row]:
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
    case = f"{case_name(frames.name, frames.camera.width, frames.camera.height)} {system}"
    note = f"{100 * share:.1f} %, {values['checkpoint_mb']:.0f} MB"
    rows = [_row(case, "a checkpoint", cost, note, values)]
    if after_s is not None:
        n = f"{len(mapper.gaussians) / 1e3:.1f}k Gaussians"
        rows.append(_row(case, "SIGTERM to saved", Lap(after_s, 0.0), n, {"after_sigterm_s": after_s}))
    return rows


def _row(case: str, method: str, took: Lap, note: str, values: dict[str, Any]) -> Row:
    return Row(section="checkpoints", case=case, method=method, timing=summary([took]), note=note, values=values)


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
