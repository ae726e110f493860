"""Waiting times besides mapping: the import, the start of a kernel, the check of a recording, the landmarks of a frame,
the search for similar keyframes."""

import functools
import subprocess
import sys
import time
from collections.abc import Iterator

from ...backends import kernel_threads
from ...config import BackEndConfig, LandmarkConfig
from ...data import open_sequence
from ...recordings.checkup import check_recording
from ...tracking import LandmarkMap, moved_enough
from ...tracking.features import extract_features
from ...tracking.keyframe_database import KeyframeDatabase
from .frames import case_name, open_frames
from .options import BenchOptions
from .rows import Case, Row
from .timing import Lap, lap, measure, summary

KEYFRAMES = 300
"""Number of keyframes that are searched, with the features of ``VIEWS`` views of the room."""
VIEWS = 20


def cases(options: BenchOptions) -> Iterator[Case]:
    """The import compared with that of torch alone; the check of a recording for every image size; one search."""
    yield Case(section="latency", title="import", run=functools.partial(_imports, 1 if options.quick else 5))
    yield Case(section="latency", title="start of a kernel", run=lambda: [_start()])
    for size in options.sizes:
        run = functools.partial(_check, options, size)
        yield Case(section="latency", title=f"check of {options.data}", run=lambda run=run: [run()])
    for size in options.sizes:
        run = functools.partial(_landmarks, options, size)
        yield Case(section="latency", title=f"landmarks of {options.data}", run=run)
    yield Case(section="latency", title="most similar views", run=lambda: [_query(options)])


def _imports(runs: int) -> Iterator[Row]:
    for module in ("torch", "gsfusion_nb"):
        laps = [_import_lap(module) for _ in range(runs + 1)][1:]  # the first one fills the system's file cache
        yield Row(section="latency", case="import in a new process", method=module, timing=summary(laps))


def _import_lap(module: str) -> Lap:
    """Time of ``import module`` in a process of its own, without the start of Python."""
    code = (
        f"import time; w, c = time.perf_counter(), time.process_time(); import {module}; "
        "print(time.perf_counter() - w, time.process_time() - c)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    wall_s, cpu_s = map(float, done.stdout.split())
    return Lap(wall_s, cpu_s)


def _start(starts: int = 200) -> Row:
    """A numba kernel that does nothing, a millisecond after the one before, as within a frame of a map."""
    (threads, start), laps = kernel_threads(), []
    for _ in range(starts):
        time.sleep(1e-3)
        laps.append(lap(start))
    return Row(section="latency", case="start of a kernel", method=f"numba on {threads}", timing=summary(laps))


def _check(options: BenchOptions, size: tuple[int, int]) -> Row:
    frames = open_frames(options, size)
    for i in range(len(frames)):
        frames[i]  # the room's pictures are rendered once and kept; a recording's files are then in memory
    timing = summary([lap(lambda: check_recording(frames))])
    case = case_name(frames.name, frames.camera.width, frames.camera.height)
    return Row(section="latency", case=case, method="check", timing=timing, note=f"{len(frames)} frames")


def _landmarks(options: BenchOptions, size: tuple[int, int]) -> Iterator[Row]:
    """What landmarks cost in the last frame, with keyframes at the poses of the data before it."""
    frames, settings = open_frames(options, size), BackEndConfig()
    extract = functools.partial(extract_features, count=settings.features, levels=settings.levels)
    for _ in range(2):  # the first time kernels may be compiled
        known, laps = LandmarkMap(frames.camera), []
        for frame in (frames[i] for i in range(len(frames) - 1)):
            if not len(known) or moved_enough(known.database.T_WC[-1], frame.T_WC, settings):
                features = extract(frame)
                laps.append(lap(functools.partial(known.add, frame.index, frame.T_WC, features)))
    last = frames[len(frames) - 1]
    features = extract(last)
    seen = known.see(features, last.T_WC)
    rows = None if seen is None else seen.extra(LandmarkConfig().sigma_m)
    timings = {
        "features of a frame": measure(lambda: extract(last), budget_s=options.budget_s),
        "landmarks that it sees": measure(lambda: known.see(features, last.T_WC), budget_s=options.budget_s),
        "a step of ICP": None if rows is None else measure(lambda: rows(last.T_WC), budget_s=options.budget_s),
        "a new keyframe": summary(laps[1:] or laps),  # the first one has no landmarks to find
    }
    case = case_name(frames.name, frames.camera.width, frames.camera.height)
    n = 0 if seen is None else len(seen.rows)
    for part, timing in timings.items():
        if timing is not None:
            yield Row(section="latency", case=case, method=part, timing=timing, note=f"{n} landmarks")


def _query(options: BenchOptions) -> Row:
    sequence = open_sequence("room", n_frames=400).mapping
    frames = [sequence[6 * i] for i in range(VIEWS)]
    views = [extract_features(frame, count=1000, levels=8) for frame in frames]
    known = KeyframeDatabase(sequence.camera)
    for row in range(KEYFRAMES):
        known.add(row, frames[row % VIEWS].T_WC, views[row % VIEWS])
    timing = measure(lambda: known.similar(views[-1], 5), budget_s=options.budget_s)
    return Row(section="latency", case=f"{KEYFRAMES} keyframes", method="most similar views", timing=timing)
