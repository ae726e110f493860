"""Where the time of a run goes: stages that add up to the whole."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from ..compile_clock import COMPILE_CLOCK

STAGES = (
    "opening",
    "compiling",
    "reading",
    "mapping",
    "passes",
    "mesh",
    "writing",
    "checkpoints",
    "view_scores",
    "mesh_scores",
    "report",
    "other",
)
"""Names of the stages, in about the order of a run; what is in no stage counts as other. Compiling
kernels is a stage of its own wherever it happens."""


class Times(NamedTuple):
    """Readings of two clocks, or what passed on both, seconds."""

    wall_s: float
    cpu_s: float

    def since(self, earlier: "Times") -> "Times":
        """What passed between ``earlier`` and these readings."""
        return Times(self.wall_s - earlier.wall_s, self.cpu_s - earlier.cpu_s)


class RunClock:
    """Adds up the time of each stage: ``with clock("reading"): ...``. A stage inside another counts
    for itself alone.

    Only the thread that made it is counted: frames that another one decodes in advance count as
    reading while they are waited for.

    Args:
        clock: Returns the time in seconds.
        cpu: Returns the processor time of the process in seconds.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.perf_counter,
        cpu: Callable[[], float] = time.process_time,
    ):
        self._now = clock
        self._cpu = cpu
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        """Stage -> wall time so far, seconds."""
        self.cpu_seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        """Stage -> processor time so far, seconds, of all threads."""
        self._thread = threading.get_ident()
        self._open_stages = ["other"]
        """The stages that the run is in, the innermost last."""
        self._last_count = Times(clock(), cpu())
        self._last_compiled = _compiled()

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if threading.get_ident() != self._thread:
            yield
            return
        self._count()
        self._open_stages.append(stage)
        try:
            yield
        finally:
            self._count()
            self._open_stages.pop()

    def metrics(self) -> dict[str, float]:
        """Seconds of each stage so far, and their sum, with their names in metrics.json."""
        self._count()
        return {f"seconds_{stage}": s for stage, s in self.seconds.items()} | {
            "seconds_total": self.total
        }

    @property
    def total(self) -> float:
        """Wall time of all stages, seconds."""
        return sum(self.seconds.values())

    def state_dict(self) -> dict[str, dict[str, float]]:
        """The times so far."""
        self._count()
        return {"seconds": dict(self.seconds), "cpu_seconds": dict(self.cpu_seconds)}

    def load_state_dict(self, state: dict[str, dict[str, float]]) -> None:
        """Add the times of the run before it was interrupted."""
        for name, times in state.items():
            mine = getattr(self, name)
            for stage, seconds in times.items():
                mine[stage] = mine.get(stage, 0.0) + seconds

    def _count(self) -> None:
        """Add the time since the last count to the innermost stage; that of compiling to its
        own."""
        now = Times(self._now(), self._cpu())
        compiled = _compiled()
        passed = now.since(self._last_count)
        compiling = compiled.since(self._last_compiled)
        stage = self._open_stages[-1]
        self.seconds[stage] += passed.wall_s - compiling.wall_s
        self.cpu_seconds[stage] += passed.cpu_s - compiling.cpu_s
        self.seconds["compiling"] += compiling.wall_s
        self.cpu_seconds["compiling"] += compiling.cpu_s
        self._last_count = now
        self._last_compiled = compiled


def _compiled() -> Times:
    """The time that this process has spent on compiling kernels."""
    return Times(COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds)
