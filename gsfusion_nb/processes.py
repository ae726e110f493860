"""Jobs shared out to several processes, so that jobs which need the same thing do not run at the same time."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Died:
    """The result of a job whose process ended without one: it was killed, or ran out of memory."""


class WorkerPool:
    """Processes that do one job at a time, as a context manager; at its end they are ended.

    A process is started when there is a job for it, also in place of one that died.

    Args:
        job: A function of a module; its arguments and results can be pickled.
        n_processes: The most processes.
        environment: Environment variables of the processes.
    """

    def __init__(self, job: Callable[..., Any], n_processes: int, environment: Mapping[str, str] | None = None):
        self._job, self._most = job, n_processes
        self._environment = dict(environment or {})
        self._context = multiprocessing.get_context("spawn")
        self._processes: dict[Connection, Any] = {}
        self._free: list[Connection] = []
        self._running: dict[Connection, int] = {}

    def __enter__(self) -> "WorkerPool":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.join()

    @property
    def has_room(self) -> bool:
        """Whether a process is free, or can be started."""
        return bool(self._free) or len(self._processes) < self._most

    @property
    def running(self) -> set[int]:
        """Numbers of the jobs that have been started and not returned."""
        return set(self._running.values())

    def start(self, number: int, arguments: tuple) -> None:
        """Begin ``job(*arguments)`` in a free process; ``wait`` returns its result with ``number``."""
        connection = self._free.pop() if self._free else self._new()
        self._running[connection] = number
        with contextlib.suppress(OSError):  # it has died, which ``wait`` notices
            connection.send(arguments)

    def end(self, number: int) -> None:
        """End the process of a job that is running; ``wait`` returns it as ``Died``."""
        for connection in [c for c, running in self._running.items() if running == number]:
            self._processes[connection].kill()

    def wait(self, most_s: float | None = None) -> list[tuple[int, Any]]:
        """Wait for the next jobs to end, or for this long. Returns number and result of each: None if the job raised,
        ``Died`` (the class) if its process ended."""
        ended = []
        for connection in wait(list(self._running), most_s):
            assert isinstance(connection, Connection)
            number = self._running.pop(connection)
            try:
                ended.append((number, connection.recv()))
                self._free.append(connection)
            except (EOFError, OSError):
                self._processes.pop(connection).join()
                ended.append((number, Died))
        return ended

    def _new(self) -> Connection:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(self._job, theirs), daemon=True)
        before = {name: os.environ.get(name) for name in self._environment}
        os.environ.update(self._environment)
        try:
            process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        theirs.close()
        self._processes[ours] = process
        return ours


def run_in_processes(
    job: Callable[..., Any], arguments: Sequence[tuple], needs: Sequence[frozenset[str]], n_processes: int
) -> Iterator[tuple[int, Any]]:
    """Call ``job(*arguments[i])`` for every i in one of ``n_processes`` new processes; yield (i, result) when done.

    A free process takes the first job left that shares no need with a running one, or waits.

    Args:
        job: A function of a module, and its results can be pickled.
        arguments: Of each call.
        needs: What each call needs for itself.
        n_processes: The most processes.

    The result is None if the job raised or its process was ended from outside. If the caller stops iterating, the
    processes are ended.
    """
    left = list(range(len(arguments)))
    with WorkerPool(job, n_processes) as pool:
        while left or pool.running:
            while pool.has_room and (i := _next(left, needs, pool.running)) is not None:
                left.remove(i)
                pool.start(i, arguments[i])
            yield from ((i, None if result is Died else result) for i, result in pool.wait())


def _next(left: list[int], needs: Sequence[frozenset[str]], running: set[int]) -> int | None:
    busy = frozenset().union(*(needs[i] for i in running))
    return next((i for i in left if not busy & needs[i]), None)


def _serve(job: Callable[..., Any], connection: Any) -> None:
    """In a process: do what is asked until it is ended, or the process that asks is gone."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that shares the jobs out
    while True:
        try:
            arguments = connection.recv()
        except EOFError:
            return
        try:
            result = job(*arguments)
        except Exception:
            result = None
        connection.send(result)


def _end_with_parent() -> None:
    """End this process, in the middle of a job too, when the process that started it was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
