"""Where the time of a run goes: stages that add up to the whole."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

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
        self._inside = ["other"]
        self._since = clock(), cpu()
        self._compiled = COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if threading.get_ident() != self._thread:
            yield
            return
        self._count()
        self._inside.append(stage)
        try:
            yield
        finally:
            self._count()
            self._inside.pop()

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
        """Add the time since the last change to the stage that is open."""
        instant = self._now()
        cpu = self._cpu()
        compiled = COMPILE_CLOCK.seconds, COMPILE_CLOCK.cpu_seconds
        compiling_s = compiled[0] - self._compiled[0]
        compiling_cpu_s = compiled[1] - self._compiled[1]
        stage = self._inside[-1]
        self.seconds[stage] += instant - self._since[0] - compiling_s
        self.cpu_seconds[stage] += cpu - self._since[1] - compiling_cpu_s
        self.seconds["compiling"] += compiling_s
        self.cpu_seconds["compiling"] += compiling_cpu_s
        self._since = instant, cpu
        self._compiled = compiled
