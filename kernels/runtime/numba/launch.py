"""Launching compiled kernels: one at a time, with as many threads as torch uses."""

import contextlib
import threading
from collections.abc import Iterator

import numba
import numpy as np
import torch

# Numba makes its settings at run time:
# pyright: reportAttributeAccessIssue=false

if numba.config.THREADING_LAYER == "default":
    numba.config.THREADING_LAYER = "workqueue"
"""Its idle threads sleep. OpenMP's spin, and with another program on the cores a map then takes ten times as long."""

_LOCK = threading.RLock()


_BUFFERS: dict[str, np.ndarray] = {}


def scratch(name: str, size: int) -> np.ndarray:
    """``size`` float32 of memory that is used again by the next call of this name; only inside ``launching``.

    An optimisation step asks for the same few megabytes again and again; fresh ones cost a page fault per 4 kB.
    """
    buffer = _BUFFERS.get(name)
    if buffer is None or buffer.size < size:
        buffer = _BUFFERS[name] = np.empty(size + size // 4, np.float32)
    return buffer[:size]


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Hold the kernels for this thread: numba's workqueue ends the process when two launch at once."""
    with _LOCK:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
        yield
