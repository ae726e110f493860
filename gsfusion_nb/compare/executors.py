"""Where runs are done: in this process, in several on this machine, or on a Dask cluster; and what each does."""

import contextlib
import dataclasses
import math
import pickle
import tempfile
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from ..backends import use_backend
from ..mapping import StepReport
from ..seeding import SeedingRule, rule_name
from ..work import Died, WorkerPool, usable_cores
from .map_scene import Entry, OnStep
from .one_run import run_entry
from .spec import RunResult, RunSpec, run_key
from .tune import tune, tuning_spec

_ONE_AT_A_TIME = threading.Lock()
"""Two runs in one process would share its threads, and each would be charged for the other's time and memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """One piece of work; it can be sent to another process."""

    kind: Literal["tune", "run"]
    spec: RunSpec
    backend: str
    """Backend that is in use where the comparison was started."""
    rule: SeedingRule | bytes | None = None
    """A rule that was defined in this process; as bytes on the way to another one."""
    sequence: Any = None
    """Frames that the caller has opened; they cannot be sent."""
    tuned: dict[str, Any] | None = None
    """Result of the tuning, for a run."""
    with_pictures: bool = True
    """Whether pictures of some held-out views are made."""
    program: str = ""
    """``run_key()`` where the comparison was started; empty asks for nothing."""

    def packed(self) -> "Task":
        """The task as it is sent to another process.

        Raises:
            ValueError: its frames are in memory, or its rule cannot be sent.
        """
        if self.sequence is not None:
            raise ValueError(
                f"{self.spec.scene} was opened in this process: give its name or folder, or use one process"
            )
        return self if self.rule is None else dataclasses.replace(self, rule=_pickled(self.rule))


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a task gave."""

    result: RunResult | None = None
    """Of a run."""
    tuned: dict[str, Any] | None = None
    """Of a tuning."""
    reason: str = ""
    """Why there is neither."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Content of the picture files of a run, by name."""


def do_task(task: Task, on_step: OnStep = lambda report: None) -> Answer:
    """Do a piece of work. Raises nothing; a failure is in the answer.

    ``on_step`` is called after each frame, and after other pieces of work with None.
    """
    with _ONE_AT_A_TIME, use_backend(task.backend):
        try:
            if task.program not in ("", run_key()):
                raise ValueError(
                    "this process has another version of gsfusion_nb, or of a library, than the comparison"
                )
            rule = pickle.loads(task.rule) if isinstance(task.rule, bytes) else task.rule
            entry = Entry(spec=task.spec, rule=rule, sequence=task.sequence)
            if task.kind == "tune":
                return Answer(tuned=tune(dataclasses.replace(entry, spec=tuning_spec(entry.spec)), on_step))
            return _run(entry, task, on_step)
        except Exception as e:  # a user's rule may raise anything
            return Answer(reason=f"{type(e).__name__}: {e}")


def _run(entry: Entry, task: Task, on_step: OnStep) -> Answer:
    if not task.with_pictures:
        return Answer(result=run_entry(entry, None, task.tuned, on_step))
    with tempfile.TemporaryDirectory(prefix="gsfusion-lab-") as folder:
        result = run_entry(entry, Path(folder), task.tuned, on_step)
        pictures = {name: (Path(folder) / name).read_bytes() for name in result.pictures.values()}
    return Answer(result=result, pictures=pictures)


def _pickled(rule: SeedingRule | bytes) -> bytes:
    """A rule for another process; one of a notebook needs cloudpickle, which comes with Dask."""
    pickler: Any = pickle
    with contextlib.suppress(ImportError):
        import cloudpickle as pickler
    try:
        return pickler.dumps(rule)
    except (pickle.PicklingError, AttributeError, TypeError) as e:
        raise ValueError(
            f"the rule {rule_name(rule)} cannot be sent to other processes: {e}; write it to a file and give "  # pyright: ignore
            '"FILE.py:name", or install the extra "cluster"'
        ) from None


MOST_TRIES = 2
"""A task whose process ends twice fails."""
CONNECT_S = 10.0
"""How long a Dask scheduler may take to answer, seconds."""
NO_WORKER_S = 60.0
"""How long a Dask cluster that had workers may be without any before a comparison ends, seconds."""
RUN_LIMIT_S = 6 * 3600.0
"""How long a run may take in another process before it fails, seconds."""
_LOOK_S = 1.0
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


@runtime_checkable
class Executor(Protocol):
    """Does tasks, in any order."""

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        ...

    def get(self) -> tuple[int, Answer]:
        """Wait for the next answer."""
        ...


class _Waiting:
    """Tasks in order, runs before tunings: the first results are there early, and what is left can be estimated."""

    def __init__(self):
        self._runs: deque[tuple[int, Task]] = deque()
        self._others: deque[tuple[int, Task]] = deque()

    def __len__(self) -> int:
        return len(self._runs) + len(self._others)

    def append(self, item: tuple[int, Task]) -> None:
        (self._runs if item[1].kind == "run" else self._others).append(item)

    def popleft(self) -> tuple[int, Task]:
        return (self._runs or self._others).popleft()


class InProcess:
    """One task after another, in this process; ``on_step`` is called with the task before it, and after each frame."""

    def __init__(self, on_step: "Callable[[Task, StepReport | None], object]" = lambda task, report: None):
        self._tasks, self._on_step = _Waiting(), on_step

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        self._tasks.append((number, task))

    def get(self) -> tuple[int, Answer]:
        """Do the next task."""
        number, task = self._tasks.popleft()
        self._on_step(task, None)
        return number, do_task(task, lambda report: self._on_step(task, report))


class InProcesses:
    """Several processes on this machine, which divide its cores. A task whose process dies is repeated once; one that
    takes longer than ``limit_s`` has failed, and its process is ended."""

    def __init__(self, pool: WorkerPool, limit_s: float = RUN_LIMIT_S):
        self._pool, self._limit_s = pool, limit_s
        self._began: dict[int, float] = {}
        self._late: set[int] = set()
        self._tasks = _Waiting()
        self._all: dict[int, Task] = {}
        self._tries: Counter[int] = Counter()
        self._answers: deque[tuple[int, Answer]] = deque()

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        self._all[number] = task.packed()
        self._tasks.append((number, self._all[number]))

    def get(self) -> tuple[int, Answer]:
        """Wait for the next answer."""
        while not self._answers:
            while self._tasks and self._pool.has_room:
                number, task = self._tasks.popleft()
                self._tries[number] += 1
                self._pool.start(number, (task,))
                self._began[number] = time.monotonic()
            for number, answer in self._pool.wait(_LOOK_S):
                self._ended(number, answer)
            for number in self._pool.running - self._late:
                if time.monotonic() - self._began[number] > self._limit_s:
                    self._late.add(number)
                    self._pool.end(number)
        return self._answers.popleft()

    def _ended(self, number: int, answer: Any) -> None:
        if isinstance(answer, Answer):
            self._answers.append((number, answer))
        elif number in self._late:
            self._answers.append((number, _too_long(self._limit_s)))
        elif self._tries[number] < MOST_TRIES:
            self._tasks.append((number, self._all[number]))
        else:
            why = "ended without a result (killed, or out of memory)" if answer is Died else "gave no result"
            self._answers.append((number, Answer(reason=f"its process {why}, {MOST_TRIES} times")))


class NoWorkerError(RuntimeError):
    """A Dask cluster has lost all its workers."""


class OnDask:
    """A Dask cluster. Its scheduler repeats the tasks of a worker that is lost.

    Args:
        client: Of the cluster.
        limit_s: A task that takes longer has failed, and its worker is started again.
        no_worker_s: How long the cluster may be without any worker after it has had one.
    """

    def __init__(self, client: Any, limit_s: float = RUN_LIMIT_S, no_worker_s: float = NO_WORKER_S):
        self._client, self._limit_s, self._no_worker_s = client, limit_s, no_worker_s
        self._numbers: dict[Any, int] = {}
        self.topic = f"gsfusion-lab-{uuid.uuid4().hex}"
        """Of the events by which workers say which task they begin."""
        self._began: dict[int, tuple[float, str]] = {}
        self._n_events, self._alone_since = 0, math.inf

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        future = self._client.submit(
            _do_on_worker, task.packed(), number, self.topic, pure=False, priority=int(task.kind == "run")
        )
        self._numbers[future] = number

    def get(self) -> tuple[int, Answer]:
        """Wait for the next answer.

        Raises:
            NoWorkerError: all workers are lost, and no other one has come.
        """
        from distributed import wait

        while True:
            with contextlib.suppress(TimeoutError):
                found: Any = wait(list(self._numbers), timeout=_LOOK_S, return_when="FIRST_COMPLETED")
                future = min(found.done, key=lambda future: self._numbers[future])
                number, error = self._numbers.pop(future), future.exception()
                if error is None:
                    return number, future.result()
                return number, Answer(reason=f"the cluster gave it up: {type(error).__name__}: {error}")
            if (late := self._late()) is not None:
                return late, _too_long(self._limit_s)
            self._check_workers()

    def _late(self) -> int | None:
        """A task that has taken too long; it is given up, and its worker ended."""
        events = self._client.get_events(self.topic) or ()
        for _, event in events[self._n_events :]:
            self._began[event["number"]] = time.monotonic(), event["worker"]
        self._n_events = len(events)
        for future, number in self._numbers.items():
            began, worker = self._began.get(number, (math.inf, ""))
            if time.monotonic() - began > self._limit_s:
                del self._numbers[future]
                future.cancel(force=True)
                with contextlib.suppress(Exception):  # a worker without a nanny cannot be started again
                    self._client.restart_workers([worker], timeout=CONNECT_S, raise_for_error=False)
                return number
        return None

    def _check_workers(self) -> None:
        if self._client.scheduler_info()["workers"]:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > self._no_worker_s:
            raise NoWorkerError(
                f"the Dask cluster has had no worker for {self._no_worker_s:g} s: start one "
                f"(dask worker {self._client.scheduler.address}) and repeat the command; finished runs are kept"
            )


def _do_on_worker(task: Task, number: int, topic: str) -> Answer:
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(topic, {"number": number, "worker": worker.address})
    return do_task(task)


def _too_long(limit_s: float) -> Answer:
    return Answer(reason=f"it took longer than {limit_s / 60:g} min, the limit of a run, and was ended")


@contextlib.contextmanager
def executor(jobs: int = 1, dask: str = "", limit_s: float = RUN_LIMIT_S) -> Iterator[Executor]:
    """An executor, as a context manager; at its end nothing of it is left running.

    Args:
        jobs: Number of processes on this machine; 1 uses this process.
        dask: Address of the scheduler of a Dask cluster ("tcp://host:8786"), or "local" for a cluster of ``jobs``
            worker processes on this machine; empty uses none.
        limit_s: A run in another process that takes longer has failed, and its process is ended; one that hangs in this
            process hangs.

    Raises:
        ValueError: the extra "cluster" is not installed, or there is no scheduler at the address.
    """
    if dask:
        with _client(jobs, dask) as client:
            yield OnDask(client, limit_s)
    elif jobs > 1:
        with WorkerPool(do_task, jobs, threads_of_each(jobs)) as pool:
            yield InProcesses(pool, limit_s)
    else:
        yield InProcess()


def threads_of_each(jobs: int) -> dict[str, str]:
    """Environment in which each of ``jobs`` processes uses its share of the cores, so that they do not fight."""
    return dict.fromkeys(_THREADS, str(max(usable_cores() // jobs, 1)))


@contextlib.contextmanager
def _client(jobs: int, address: str) -> Iterator[Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise ValueError("a Dask cluster needs the extra \"cluster\": pip install 'gsfusion-nb[cluster]'") from None
    if address != "local":
        try:
            client = Client(address, timeout=CONNECT_S)
        except OSError as e:
            raise ValueError(f"no Dask scheduler answers at {address}: {e}") from None
        with client:
            yield client
        return
    no_dashboard: Any = None
    with (
        LocalCluster(n_workers=max(jobs, 1), threads_per_worker=1, processes=True, dashboard_address=no_dashboard,
                     env=threads_of_each(max(jobs, 1))) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        yield client
