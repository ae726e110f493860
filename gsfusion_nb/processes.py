"""Jobs shared out to several processes, so that jobs which need the same thing do not run at the same time."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    context = multiprocessing.get_context("spawn")
    left, free, running = list(range(len(arguments))), [], {}
    processes = []
    try:
        for _ in range(min(n_processes, len(arguments))):
            ours, theirs = context.Pipe()
            processes.append(context.Process(target=_serve, args=(job, theirs), daemon=True))
            processes[-1].start()
            theirs.close()
            free.append(ours)
        while left or running:
            while free and (i := _next(left, needs, set(running.values()))) is not None:
                left.remove(i)
                running[free[-1]] = i
                with contextlib.suppress(OSError):
                    free[-1].send(arguments[i])
                free.pop()
            if not running:  # every process has ended
                yield from ((i, None) for i in left)
                return
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                i = running.pop(connection)
                try:
                    result = connection.recv()
                    free.append(connection)
                except (EOFError, OSError):
                    result = None
                yield i, result
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _next(left: list[int], needs: Sequence[frozenset[str]], running: set[int]) -> int | None:
    busy = frozenset().union(*(needs[i] for i in running))
    return next((i for i in left if not busy & needs[i]), None)


def _serve(job: Callable[..., Any], connection: Any) -> None:
    """In a process: do what is asked until it is ended."""
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
