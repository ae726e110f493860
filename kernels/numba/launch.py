"""Launching compiled kernels: one at a time, with as many threads as torch uses."""

import contextlib
import threading
from collections.abc import Iterator

import numba
import torch

# Numba makes its settings at run time:
# pyright: reportAttributeAccessIssue=false

if numba.config.THREADING_LAYER == "default":
    numba.config.THREADING_LAYER = "workqueue"
"""Its idle threads sleep. OpenMP's spin, and with another program on the cores a map then takes ten times as long."""

_LOCK = threading.RLock()


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Hold the kernels for this thread: numba's workqueue ends the process when two launch at once."""
    with _LOCK:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
        yield
