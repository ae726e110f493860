"""Long work: its progress, jobs in several processes, and how much memory is left."""

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

if TYPE_CHECKING:
    import torch

T = TypeVar("T")

EVERY_S = 10.0
"""Time between two lines of a log."""

GROWTH = {"cpu": 2.0, "cuda": 1.25}
"""A map that is full grows by this factor. Untouched memory is free on a CPU; on a GPU it is taken from the rest."""


class ProgressDisplay:
    """Progress of one piece of work, as a context manager; the log gets a last line when the block ends.

        with ProgressDisplay("mapping", total=len(frames), unit="frame") as progress:
            for n, frame in enumerate(frames, start=1):
                ...
                progress.show(n, note=f"PSNR {psnr_db:.1f} dB")

    Args:
        what: What is being done, a word or two.
        total: How much there is to do; None if that is not known (yet).
        unit: What is counted, in the singular; "B" for bytes, which are shown in kB, MB or GB.
        done: How much was done before.
        leave: Whether a terminal keeps the bar when the work is done. If False, a log is not told of work that is over
            before its first line.
        shown: False shows nothing at all.
        stream: Where to; standard error by default.
        clock: Seconds.
    """

    def __init__(
        self,
        what: str,
        *,
        total: int | None = None,
        unit: str = "",
        done: int = 0,
        leave: bool = True,
        shown: bool = True,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        to: TextIO = stream or sys.stderr
        self._display: _Bar | _Lines | None = None
        if shown and (to.isatty() or _in_notebook()):
            self._display = _Bar(what, total, unit, done, leave, to)
        elif shown:
            self._display = _Lines(what, total, unit, done, leave, to, clock)

    def show(self, done: int, *, total: int | None = None, what: str | None = None, note: str = "") -> None:
        """Say how much is done now.

        Args:
            done: In all.
            total: How much there is to do, if that has changed.
            what: In place of what was said at first.
            note: More about the present state.
        """
        if self._display is not None:
            self._display.show(done, total, what, note)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items one after another; each counts as done when the next one is asked for."""
        for done, item in enumerate(items, start=1):
            yield item
            self.show(done)

    def close(self) -> None:
        """The work is over, finished or not."""
        if self._display is not None:
            self._display.close()

    def __enter__(self) -> "ProgressDisplay":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class _Bar:
    """tqdm's bar: a line that is drawn over itself, or a widget."""

    def __init__(self, what: str, total: int | None, unit: str, done: int, leave: bool, stream: TextIO):
        from tqdm.auto import tqdm

        self._bar = tqdm(
            desc=what, total=total, unit=unit or "it", unit_scale=unit == "B", initial=done, leave=leave, file=stream
        )

    def show(self, done: int, total: int | None, what: str | None, note: str) -> None:
        if total is not None:
            self._bar.total = total
        if what is not None:
            self._bar.set_description_str(what, refresh=False)
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        self._bar.close()


class _Lines:
    """Lines for a log file, a pipe, or continuous integration."""

    def __init__(
        self,
        what: str,
        total: int | None,
        unit: str,
        done: int,
        leave: bool,
        stream: TextIO,
        clock: Callable[[], float],
    ):
        self._what, self._total, self._unit, self._done = what, total, unit, done
        self._leave, self._stream, self._clock, self._note = leave, stream, clock, ""
        self._begun_s = self._said_s = clock()
        self._said = ""

    def show(self, done: int, total: int | None, what: str | None, note: str) -> None:
        self._done, self._note = done, note
        self._total = self._total if total is None else total
        self._what = what or self._what
        if self._clock() - self._said_s >= EVERY_S:
            self._say()

    def close(self) -> None:
        if (self._leave or self._said) and (self._note or self._done):
            self._say()

    def _say(self) -> None:
        self._said_s = self._clock()
        if (state := self._state()) != self._said:
            self._said = state
            self._stream.write(f"{state}, {self._said_s - self._begun_s:.0f} s{self._note and '; '}{self._note}\n")
            self._stream.flush()

    def _state(self) -> str:
        if self._unit == "B":
            count = _bytes(self._done) + (f" of {_bytes(self._total)}" if self._total else "")
        else:
            of = f" of {self._total:,}" if self._total else ""
            plural = "s" if self._unit and (self._total or self._done) != 1 else ""
            count = f"{self._done:,}{of} {self._unit}{plural}".rstrip()
        share = f" ({100 * self._done / self._total:.0f} %)" if self._total else ""
        return f"{self._what}: {count}{share}"


def _bytes(n: int) -> str:
    for power, name in ((9, "GB"), (6, "MB"), (3, "kB")):
        if n >= 10**power:
            return f"{n / 10**power:.1f} {name}"
    return f"{n} B"


def _in_notebook() -> bool:
    """Whether a Jupyter kernel shows what is printed."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    shell = get_ipython()
    return shell is not None and "IPKernelApp" in shell.config


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


def available_memory(device: "torch.device") -> int | None:
    """Bytes that can still be allocated on ``device``; None where the system does not report it."""
    if device.type == "cuda":
        import torch

        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    meminfo = Path("/proc/meminfo")
    if device.type != "cpu" or not meminfo.exists():
        return None
    for line in meminfo.read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


class PeakMemory:
    """Growth of memory inside a block, ``peak_mb``: the largest resident set minus that at the start.

    Linux stores the largest resident set of a process, and the process can reset it; on other systems the result is
    None. On a GPU it is the memory that torch allocated.
    """

    def __init__(self, device: str = "cpu"):
        self.device = device
        self.peak_mb: float | None = None
        self._before = 0

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        if self.device == "cuda":
            import torch

            torch.cuda.reset_peak_memory_stats()
            self._before = torch.cuda.memory_allocated()
            return self
        _return_free_memory()
        self._before = _resident_bytes("VmRSS") if _reset_peak() else -1
        return self

    def __exit__(self, *_) -> None:
        if self.device == "cuda":
            import torch

            self.peak_mb = (torch.cuda.max_memory_allocated() - self._before) / 1e6
        elif self._before >= 0:
            self.peak_mb = max(0, _resident_bytes("VmHWM") - self._before) / 1e6


def _resident_bytes(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    return 0


def _reset_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): resets VmHWM to the current resident set
    except OSError:
        return False
    return True


def _return_free_memory() -> None:
    """Return freed memory to the system; otherwise work that reuses it would seem to need none."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def memory_is_full(error: BaseException) -> bool:
    """Whether an error says, in the words of Python, torch, OpenCV or C++, that there is no more memory."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    text = str(error)
    return any(
        words in text for words in ("can't allocate memory", "bad_alloc", "Insufficient memory", "Cannot allocate")
    )
