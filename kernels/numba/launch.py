"""Launching compiled kernels: one at a time, with as many threads as torch uses."""

import contextlib
import threading
from collections.abc import Iterator

import numba
import torch

_LOCK = threading.RLock()


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Hold the kernels for this thread: numba's portable threading layer ends the process when two launch at once."""
    with _LOCK:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # pyright: ignore[reportAttributeAccessIssue]
        yield
