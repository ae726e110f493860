"""Launching compiled kernels: one at a time, with as many threads as torch uses."""

import contextlib
import ctypes
import importlib
import importlib.metadata
import threading
from collections.abc import Iterator

import numba
import numpy as np
import torch
from numba import njit, prange

# Numba makes its settings at run time:
# pyright: reportAttributeAccessIssue=false

_TBB = ("libtbb.so.12", "tbb12.dll")
"""The library of oneTBB on Linux and on Windows."""


def _load_tbb() -> None:
    """Load oneTBB from its wheel, which puts it where the system does not look; without a wheel
    nothing happens."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError, OSError):
        for file in importlib.metadata.files("tbb") or ():
            if file.name in _TBB:
                ctypes.CDLL(str(file.locate()))


# Threads of oneTBB start a task after 20 microseconds; those of numba's own workqueue, which are
# all woken for each task, after 150 (a virtual machine with two cores; a frame of a map has dozens
# of tasks). The idle threads of both sleep. OpenMP's spin, and with another program on the cores a
# map then takes ten times as long.
if numba.config.THREADING_LAYER == "default":
    _load_tbb()
    numba.config.THREADING_LAYER_PRIORITY = ["tbb", "workqueue", "omp"]


def threads_from() -> str:
    """Whose threads the kernels run on, of those that numba knows: "tbb", "omp" or "workqueue"."""
    if numba.config.THREADING_LAYER != "default":
        return numba.config.THREADING_LAYER
    try:
        importlib.import_module("numba.np.ufunc.tbbpool")
    except ImportError:
        return "workqueue"
    return "tbb"


_LOCK = threading.RLock()


_BUFFERS: dict[str, np.ndarray] = {}


def scratch(name: str, size: int) -> np.ndarray:
    """``size`` float32 of memory that is used again by the next call of this name; only inside
    ``launching``.

    An optimisation step asks for the same few megabytes again and again; fresh ones cost a page
    fault per 4 kB.
    """
    buffer = _BUFFERS.get(name)
    if buffer is None or buffer.size < size:
        buffer = _BUFFERS[name] = np.empty(size + size // 4, np.float32)
    return buffer[:size]


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Hold the kernels for this thread: numba's workqueue ends the process when two launch at
    once."""
    with _LOCK:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
        yield


@njit(parallel=True, cache=True)
def _set_all(done):
    for i in prange(len(done)):
        done[i] = 1


def start_threads() -> None:
    """Run a kernel that does next to nothing, to measure what starting one costs."""
    with launching():
        _set_all(np.zeros(64, np.uint8))
