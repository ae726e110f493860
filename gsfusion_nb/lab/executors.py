"""Where the runs of a comparison are done: in this process, in several on this machine, or on a Dask cluster."""

import contextlib
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from ..processes import Died, WorkerPool, usable_cores
from .tasks import Answer, Task, do_task

MOST_TRIES = 2
"""A task whose process ends twice fails."""
CONNECT_S = 10.0
"""How long a Dask scheduler may take to answer, seconds."""
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


class InProcess:
    """One task after another, in this process."""

    def __init__(self):
        self._tasks: deque[tuple[int, Task]] = deque()

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        self._tasks.append((number, task))

    def get(self) -> tuple[int, Answer]:
        """Do the next task."""
        number, task = self._tasks.popleft()
        return number, do_task(task)


class InProcesses:
    """Several processes on this machine, which divide its cores. A task whose process dies is repeated once."""

    def __init__(self, pool: WorkerPool):
        self._pool = pool
        self._tasks: deque[tuple[int, Task]] = deque()
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
            for number, answer in self._pool.wait():
                self._ended(number, answer)
        return self._answers.popleft()

    def _ended(self, number: int, answer: Any) -> None:
        if isinstance(answer, Answer):
            self._answers.append((number, answer))
        elif self._tries[number] < MOST_TRIES:
            self._tasks.appendleft((number, self._all[number]))
        else:
            why = "ended without a result (killed, or out of memory)" if answer is Died else "gave no result"
            self._answers.append((number, Answer(reason=f"its process {why}, {MOST_TRIES} times")))


class OnDask:
    """A Dask cluster. Its scheduler repeats the tasks of a worker that is lost."""

    def __init__(self, client: Any):
        from distributed import as_completed

        self._client = client
        self._completed = as_completed()
        self._numbers: dict[Any, int] = {}

    def put(self, number: int, task: Task) -> None:
        """Add a task."""
        future = self._client.submit(do_task, task.packed(), pure=False)
        self._numbers[future] = number
        self._completed.add(future)

    def get(self) -> tuple[int, Answer]:
        """Wait for the next answer."""
        future = next(self._completed)
        number = self._numbers.pop(future)
        error = future.exception()
        if error is None:
            return number, future.result()
        return number, Answer(reason=f"the cluster gave it up: {type(error).__name__}: {error}")


@contextlib.contextmanager
def executor(jobs: int = 1, dask: str = "") -> Iterator[Executor]:
    """An executor, as a context manager; at its end nothing of it is left running.

    Args:
        jobs: Number of processes on this machine; 1 uses this process.
        dask: Address of the scheduler of a Dask cluster ("tcp://host:8786"), or "local" for a cluster of ``jobs``
            worker processes on this machine; empty uses none.

    Raises:
        ValueError: the extra "cluster" is not installed, or there is no scheduler at the address.
    """
    if dask:
        with _client(jobs, dask) as client:
            yield OnDask(client)
    elif jobs > 1:
        with WorkerPool(do_task, jobs, threads_of_each(jobs)) as pool:
            yield InProcesses(pool)
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
