"""How long a thread has been compiling kernels, so that it does not count as work.

Whoever compiles says when it begins and ends. Kernels are compiled once on a machine, in the middle
of the first call that needs them.
"""

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field


@dataclass
class _ThreadTimes(threading.local):
    depth: int = 0
    began: tuple[float, float] = (0.0, 0.0)
    seconds: float = 0.0
    cpu_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class CompileClock:
    """Adds up the time that each thread compiles; a function that is compiled within another counts
    once."""

    _times: _ThreadTimes = field(default_factory=_ThreadTimes)

    @property
    def seconds(self) -> float:
        """Wall time that the calling thread has compiled so far, seconds."""
        return self._times.seconds

    @property
    def cpu_seconds(self) -> float:
        """Processor time of it, seconds."""
        return self._times.cpu_seconds

    def begin(self) -> None:
        """The calling thread begins to compile a function."""
        if self._times.depth == 0:
            self._times.began = time.perf_counter(), time.thread_time()
        self._times.depth += 1

    def end(self) -> None:
        """The calling thread has compiled it, or has failed to."""
        self._times.depth = max(0, self._times.depth - 1)
        if self._times.depth == 0:
            wall, cpu = self._times.began
            self._times.seconds += time.perf_counter() - wall
            self._times.cpu_seconds += time.thread_time() - cpu

    def add(self, seconds: float, cpu_seconds: float) -> None:
        """Another thread has compiled so long, while the calling one waited for it."""
        self._times.seconds += seconds
        self._times.cpu_seconds += cpu_seconds

    @contextlib.contextmanager
    def compiling(self) -> Iterator[None]:
        """A block in which the calling thread compiles."""
        self.begin()
        try:
            yield
        finally:
            self.end()


COMPILE_CLOCK = CompileClock()
"""That of this process."""


def working_time() -> float:
    """``time.perf_counter`` that stands still while the calling thread compiles, seconds."""
    return time.perf_counter() - COMPILE_CLOCK.seconds
