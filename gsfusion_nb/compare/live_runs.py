"""Runs of the lab one by one, which can be paused between two frames and given up in the middle."""

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from ..mapping import StepReport
from .executors import InProcess, executor
from .map_scene import Entry
from .result import RunResult
from .run_all import run_all
from .spec import RunSpec
from .store import ResultStore
from .tasks import Answer, do_task


class _Stopped(BaseException):
    """Raised between two frames of a run that is given up; no ``except Exception`` holds it back."""


class LiveRuns(Iterator[RunResult | None]):
    """An iterator over the results of runs; one step does one run, or gives None if it was stopped.

    Args:
        runs: The runs.
        store: Where results are kept.
        jobs, dask: As for ``executors.executor``; with one job the runs are done in the thread of the step.
        on_frame: Called after each frame, and when a run has paused; only with one job.
    """

    def __init__(
        self, runs: Iterable[Entry | RunSpec], store: ResultStore, *, jobs: int = 1, dask: str = "",
        on_frame: Callable[[], None] = lambda: None,
    ):  # fmt: skip
        self._entries = [run if isinstance(run, Entry) else Entry(spec=run) for run in runs]
        self._store, self._jobs, self._dask = store, jobs, dask
        self._results: dict[int, RunResult] = {}
        self._inner: Iterator[RunResult] | None = None
        self._gate = _Gate(on_frame)

    @property
    def results(self) -> list[RunResult]:
        """Results so far, in the order of the runs."""
        return [result for _, result in sorted(self._results.copy().items())]

    @property
    def n_runs(self) -> int:
        """Number of runs, done or not."""
        return len(self._entries)

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes."""
        return list(dict.fromkeys(entry.spec.scene for entry in self._entries))

    @property
    def budgets(self) -> list[str]:
        """Texts of the budgets."""
        return list(dict.fromkeys(str(entry.spec.budget) for entry in self._entries))

    @property
    def now(self) -> str:
        """The run that is being done, in words."""
        return self._gate.now

    @property
    def is_resting(self) -> bool:
        """Whether a run waits between two frames."""
        return self._gate.is_resting

    def planned(self, scene: str, budget: str) -> Counter[str]:
        """Label -> number of runs, at one scene and budget."""
        return Counter(e.spec.label for e in self._entries if (e.spec.scene, str(e.spec.budget)) == (scene, budget))

    def pause(self) -> None:
        """Wait after the current frame."""
        self._gate.set(go=False, stop=False)

    def go_on(self) -> None:
        """Continue after ``pause`` or ``stop``."""
        self._gate.set(go=True, stop=False)

    def stop(self) -> None:
        """Give up the current run after the current frame."""
        self._gate.set(go=False, stop=True)

    def close(self) -> None:
        """Release processes; the next step starts them again."""
        inner, self._inner = self._inner, None
        if inner is not None and hasattr(inner, "close"):
            inner.close()  # pyright: ignore
        self._gate.now = ""

    def __next__(self) -> RunResult | None:
        if self._inner is None:
            self._inner = self._rest()
        try:
            return next(self._inner)
        except BaseException as e:  # a generator that raised cannot continue, and the next step makes another
            self._inner = None
            if isinstance(e, _Stopped):
                return None
            raise

    def _rest(self) -> Iterator[RunResult]:
        """The runs without a result."""
        left = [i for i in range(len(self._entries)) if i not in self._results]
        entries = [self._entries[i] for i in left]
        if self._jobs == 1 and not self._dask:
            found = run_all(entries, self._store, _Gated(self._gate))
            yield from (self._kept(left[i], result) for i, result in found)
            return
        with executor(self._jobs, self._dask) as many:
            yield from (self._kept(left[i], result) for i, result in run_all(entries, self._store, many))

    def _kept(self, i: int, result: RunResult) -> RunResult:
        self._results[i] = result
        return result


class _Gate:
    """Where a run waits between two frames."""

    def __init__(self, on_frame: Callable[[], None]):
        self._on_frame, self._wish = on_frame, threading.Condition()
        self._go, self._stop = True, False
        self.is_resting, self.now = False, ""

    def set(self, *, go: bool, stop: bool) -> None:
        """Let runs go on, wait, or end."""
        with self._wish:
            self._go, self._stop = go, stop
            self._wish.notify_all()

    def pass_by(self) -> None:
        """Called between two frames: wait while paused.

        Raises:
            _Stopped: the run is to be given up.
        """
        with self._wish:
            self.is_resting = not (self._go or self._stop)
            resting = self.is_resting
        self._on_frame()
        if resting:
            with self._wish:
                self._wish.wait_for(lambda: self._go or self._stop)
                self.is_resting = False
        if self._stop:
            raise _Stopped


class _Gated(InProcess):
    """One task after another in this thread, each of which passes the gate between two frames."""

    def __init__(self, gate: _Gate):
        super().__init__()
        self._gate = gate

    def get(self) -> tuple[int, Answer]:
        """Do the next task."""
        number, task = self._tasks.popleft()
        kind = "tuning " if task.kind == "tune" else ""
        place = f"{kind}{task.spec.label}, {task.spec.scene}, {task.spec.budget}, seed {task.spec.seed}"

        def on_step(report: StepReport | None) -> None:
            work = "optimising and scoring" if report is None else f"frame {report.frame_index}"
            self._gate.now = f"{place}, {work}"
            self._gate.pass_by()

        self._gate.now = place
        return number, do_task(task, on_step)
