"""Where runs are done: in this process, in several on this machine, or on a Dask cluster; and what
each does."""

import concurrent.futures
import contextlib
import dataclasses
import heapq
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import cloudpickle

from ..backends import use_backend
from ..errors import ArgumentError, ForeseenError
from ..mapping import StepReport
from ..resources import usable_cores
from ..seeding import SeedingRule, rule_name
from .map_scene import Entry, OnStep
from .one_run import run_entry
from .program import differing_parts, look_at_program_again
from .run_result import RunResult
from .spec import RunSpec
from .tune import tune, tuning_spec

_ONE_AT_A_TIME = threading.Lock()
"""Two runs in one process would share its threads, and each would be charged for the other's time
and memory."""


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
    program: Mapping[str, str] | None = None
    """``program_parts()`` where the comparison was started; None asks for nothing."""

    def packed(self) -> "Task":
        """The task as it is sent to another process.

        Raises:
            ValueError: its frames are in memory, or its rule cannot be sent.
        """
        if self.sequence is not None:
            raise ArgumentError(
                f"{self.spec.scene} was opened in this process: give its name or folder, or use "
                "one process"
            )
        return (
            self if self.rule is None else dataclasses.replace(self, rule=_pickle_rule(self.rule))
        )


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
            _check_program(task)
            rule = pickle.loads(task.rule) if isinstance(task.rule, bytes) else task.rule
            entry = Entry(spec=task.spec, rule=rule, sequence=task.sequence)
            if task.kind == "tune":
                return Answer(
                    tuned=tune(dataclasses.replace(entry, spec=tuning_spec(entry.spec)), on_step)
                )
            with tempfile.TemporaryDirectory(prefix="gsfusion-lab-") as folder:
                result = run_entry(entry, Path(folder), task.tuned, on_step)
                pictures = {
                    name: (Path(folder) / name).read_bytes() for name in result.pictures.values()
                }
            return Answer(result=result, pictures=pictures)
        except Exception as e:  # a user's rule may raise anything
            return Answer(reason=f"{type(e).__name__}: {e}")


def _check_program(task: Task) -> None:
    """Check that this process has the program of the comparison.

    Raises:
        ValueError: it has another version of the package or of a library, a file was edited after
            one of the two began, or a function of a library is another one there.
    """
    different = [] if task.program is None else differing_parts(task.program)
    if different:
        shown = "; ".join(different[:_SHOWN_PARTS])
        more = len(different) - _SHOWN_PARTS
        raise ArgumentError(
            "this process computes with another program than the comparison, so its numbers "
            "could differ: "
            f"{shown}{f'; and {more} more' if more > 0 else ''}. A file that was edited after a "
            "process began, or something that only one of them has set: restart both"
        )


def do_sent_task(task: Task) -> Answer:
    """``do_task`` in a process that may have been there for long: what it has loaded is compared
    anew."""
    look_at_program_again()
    return do_task(task)


def _pickle_rule(rule: SeedingRule | bytes) -> bytes:
    """A rule for another process, also one of a notebook, which it cannot import."""
    try:
        return cloudpickle.dumps(rule)
    except (pickle.PicklingError, AttributeError, TypeError) as e:
        assert not isinstance(rule, bytes)  # those can be pickled
        raise ArgumentError(
            f"the rule {rule_name(rule)} cannot be sent to other processes: {e}; write it to a "
            'file and give "FILE.py:name"'
        ) from None


CONNECT_S = 10.0
"""How long a Dask scheduler may take to answer, seconds."""
NO_WORKER_S = 60.0
"""How long a Dask cluster may be without a worker before a comparison ends, seconds."""
_LOOK_S = 1.0
_SHOWN_PARTS = 5
"""How many differences of two programs a message names."""
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class InProcess:
    """One task after another, in this process; ``on_step`` is called with the task before it, and
    after each frame."""

    def __init__(
        self, on_step: "Callable[[Task, StepReport | None], object]" = lambda task, report: None
    ):
        self._tasks = list[tuple[bool, int, Task]]()
        self._on_step = on_step

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        heapq.heappush(self._tasks, (task.kind == "tune", number, task))

    def get(self) -> tuple[int, Answer]:
        """Do the next task."""
        _, number, task = heapq.heappop(self._tasks)
        self._on_step(task, None)
        return number, do_task(task, lambda report: self._on_step(task, report))


class OnFutures:
    """Processes of this machine, or a Dask cluster, whose scheduler repeats the tasks of a worker
    that is lost.

    Args:
        submit: Begins a task elsewhere; returns its future.
        wait: Waits for the first of some futures, as ``concurrent.futures.wait``.
    """

    def __init__(
        self,
        submit: Callable[[Task], Any],
        wait: Callable[..., Any],
    ):
        self._submit = submit
        self._wait = wait
        self._numbers: dict[Any, int] = {}

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        self._numbers[self._submit(task.packed())] = number

    def get(self) -> tuple[int, Answer]:
        """Wait for the next answer."""
        futures = self._wait(list(self._numbers), return_when="FIRST_COMPLETED").done
        future = min(futures, key=lambda future: self._numbers[future])
        number = self._numbers.pop(future)
        error = future.exception()
        if error is None:
            return number, future.result()
        return number, Answer(reason=f"its process was lost: {type(error).__name__}: {error}")


Executor = InProcess | OnFutures
"""Does tasks: runs before tunings, so that the first results are there early; otherwise by their
numbers."""


@contextlib.contextmanager
def executor(jobs: int = 1, dask: str = "") -> Iterator[Executor]:
    """An executor, as a context manager; at its end nothing of it is left running.

    Args:
        jobs: Number of processes on this machine; 1 uses this process.
        dask: Address of the scheduler of a Dask cluster ("tcp://host:8786"), or "local" for a
            cluster of ``jobs`` worker processes on this machine; empty uses none.

    Raises:
        ValueError: the extra "cluster" is not installed, or there is no scheduler at the address.
    """
    if dask:
        with _client(jobs, dask) as client:
            yield on_dask(client)
    elif jobs > 1:
        with _processes(jobs) as pool:
            yield OnFutures(lambda task: _submit(pool, task), concurrent.futures.wait)
    else:
        yield InProcess()


class NoWorkerError(ForeseenError, RuntimeError):
    """A Dask cluster has no worker."""


def on_dask(client: Any) -> OnFutures:
    """The cluster of a Dask client; ``get`` raises ``NoWorkerError`` if it has no worker for
    ``NO_WORKER_S``."""
    from distributed import wait

    def submit(task: Task) -> Any:
        return client.submit(do_sent_task, task, pure=False, priority=int(task.kind == "run"))

    def wait_for_workers_too(futures: list[Any], return_when: str) -> Any:
        alone_since = time.monotonic()
        while True:
            with contextlib.suppress(TimeoutError):
                return wait(futures, timeout=_LOOK_S, return_when=return_when)
            if client.scheduler_info()["workers"]:
                alone_since = time.monotonic()
            elif time.monotonic() - alone_since > NO_WORKER_S:
                raise NoWorkerError(
                    f"the Dask cluster has had no worker for {NO_WORKER_S:g} s: start one "
                    f"(dask worker {client.scheduler.address}) and repeat the command; finished "
                    "runs are kept"
                )

    return OnFutures(submit, wait_for_workers_too)


def threads_of_each(jobs: int) -> dict[str, str]:
    """Environment in which each of ``jobs`` processes uses its share of the cores, so that they do
    not fight."""
    return dict.fromkeys(_THREADS, str(max(usable_cores() // jobs, 1)))


@contextlib.contextmanager
def _processes(jobs: int) -> Iterator[concurrent.futures.ProcessPoolExecutor]:
    """Several processes, which divide the cores; if one dies, all tasks that are left have
    failed."""
    environment = dict(os.environ)
    # what is started now reads it, and nothing here does so again
    os.environ.update(threads_of_each(jobs))
    spawn = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(jobs, spawn, initializer=_begin_process)
    try:
        yield pool
    finally:
        os.environ.clear()
        os.environ.update(environment)
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()


def _submit(pool: concurrent.futures.ProcessPoolExecutor, task: Task) -> concurrent.futures.Future:
    """Give the pool a task, for which it may start a process. That takes no Ctrl-C, which is for
    its parent: it begins with this thread's blocked signals, and imports for seconds before it can
    ignore one (``_begin_process``)."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return pool.submit(do_sent_task, task)
    signal_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(do_sent_task, task)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, signal_mask)


def _begin_process() -> None:
    """In a process of ``_processes``: Ctrl-C is for its parent, and when that was killed it ends,
    too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _client(jobs: int, address: str) -> Iterator[Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise ArgumentError(
            "a Dask cluster needs the extra \"cluster\": pip install 'gsfusion-nb[cluster]'"
        ) from None
    if address == "local":
        cluster: Any = LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            processes=True,
            env=threads_of_each(jobs),
            dashboard_address=cast(Any, None),
        )
    else:
        cluster = contextlib.nullcontext(address)
    with cluster as place:
        try:
            client = Client(place, timeout=CONNECT_S)
        except OSError as e:
            raise ArgumentError(f"no Dask scheduler answers at {address}: {e}") from None
        with client:
            yield client
