"""Timing: wall and CPU time as medians over several runs, the additional memory, and the machine
that was measured."""

import contextlib
import datetime
import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ... import __version__
from ...resources import PeakMemory

LEAST_RUNS = 3
MOST_RUNS = 30
LONG_RUN_S = 4.0
"""A run longer than this is timed only once, seconds."""
PACKAGES = ("torch", "numpy", "numba", "llvmlite", "triton", "gsplat", "opencv-python-headless")


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Medians over the runs."""

    wall_ms: float
    cpu_ms: float
    """Sum over all threads of the process."""
    runs: int
    peak_mb: float | None
    """Growth of the resident set during one run; None if the system does not report it."""
    device_ms: float | None = None
    """Time between two events of a GPU's queue; None on a CPU."""


@dataclass(frozen=True)
class Lap:
    """Times of one run."""

    wall_s: float
    cpu_s: float
    device_s: float | None = None


def lap(work: Callable[[], object], device: str = "cpu") -> Lap:
    """Time one run of ``work``; on a GPU until its queue is empty, with the time on the GPU too."""
    _wait(device)
    events = [torch.cuda.Event(enable_timing=True) for _ in range(2)] if device == "cuda" else []
    wall = time.perf_counter()
    cpu = time.process_time()
    if events:
        events[0].record()
    work()
    if events:
        events[1].record()
    _wait(device)
    wall = time.perf_counter() - wall
    cpu = time.process_time() - cpu
    return Lap(
        wall,
        cpu,
        1e-3 * events[0].elapsed_time(events[1]) if events else None,
    )


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def measure(
    work: Callable[[], object],
    budget_s: float = 1.0,
    device: str = "cpu",
) -> Timing:
    """Repeat ``work`` for about ``budget_s`` and take medians.

    An untimed first run compiles and fills caches; the first timed run also measures memory. Work
    that takes longer than ``LONG_RUN_S`` is timed only once.

    Args:
        work: Function to time; its result is discarded.
        budget_s: Time after which no further run is started, seconds.
        device: "cpu" or "cuda".
    """
    warm = lap(work, device)
    start = time.perf_counter()
    with PeakMemory(device) as memory:
        laps = [lap(work, device)]
    if warm.wall_s < LONG_RUN_S:
        while len(laps) < LEAST_RUNS or (
            time.perf_counter() - start < budget_s and len(laps) < MOST_RUNS
        ):
            laps.append(lap(work, device))
    return summary(laps, memory.peak_mb)


def summary(laps: list[Lap], peak_mb: float | None = None) -> Timing:
    """Medians of ``laps``."""
    device_s = [x.device_s for x in laps if x.device_s is not None]
    return Timing(
        wall_ms=1e3 * statistics.median(x.wall_s for x in laps),
        cpu_ms=1e3 * statistics.median(x.cpu_s for x in laps),
        runs=len(laps),
        peak_mb=peak_mb,
        device_ms=1e3 * statistics.median(device_s) if device_s else None,
    )


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch and of the numba kernels, which use torch's number."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def describe(threads: int) -> dict[str, Any]:
    """Processor, versions, and the load from other programs."""
    versions = {"gsfusion_nb": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "threads": threads,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "date": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "versions": versions,
    }


def header(machine: dict[str, Any]) -> list[str]:
    """``describe`` in a few lines of text."""
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    threads = (
        f"{machine['threads']} thread{'s' if machine['threads'] > 1 else ''} of "
        f"{machine['cores']} cores"
    )
    lines = [
        f"{machine['processor']}{gpu}; {threads}; {machine['date'][:16].replace('T', ' ')}",
        ", ".join(f"{name} {v}" for name, v in machine["versions"].items()),
    ]
    load = machine["load_average"]
    if load is not None and load > 0.5:
        lines.append(
            f"Other programs used {load:.1f} cores just before; this affects wall time more than "
            "CPU time."
        )
    return lines


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
