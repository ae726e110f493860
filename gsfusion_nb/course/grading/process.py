"""A submission's process, seen from the judge: messages with a limit of time, which is kept from
outside, and an end that nothing in it can put off."""

import contextlib
import ctypes
import multiprocessing
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

from ..learner_code import Failed, endless
from .data import LARGEST_BYTES, LENGTH, DataError, decode, encode
from .sandbox import Start

_START_S = 120.0
"""In which a process must have started, on a machine that is busy."""
_WATCH_S = 0.25
"""How often the memory of all its processes is added up."""
_ERROR_BYTES = 4096
_MOST_PROCESSES = 64
"""That a submission may start, at one time."""


class Ended(Failed):
    """The process ended, or was ended, before it answered."""


class SubmissionProcess:
    """One process, for one function of one student. A context, which ends it."""

    def __init__(self, start: Start, *, memory_mb: int):
        self._memory_mb = memory_mb
        self._errors = bytearray()
        self._received = bytearray()
        self._is_ended = False
        self._process = subprocess.Popen(
            start.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=start.folder,
            env=start.environment,
            start_new_session=True,
            bufsize=0,
        )
        assert self._process.stdin
        assert self._process.stdout
        assert self._process.stderr
        self._input = self._process.stdin.fileno()
        self._output = self._process.stdout.fileno()
        self._error = self._process.stderr.fileno()
        for descriptor in (self._input, self._output, self._error):
            os.set_blocking(descriptor, False)

    def __enter__(self) -> "SubmissionProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Kill it and what it started."""
        if self._is_ended:
            return
        self._is_ended = True
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            with contextlib.suppress(OSError):
                pipe.close()  # pyright: ignore[reportOptionalMemberAccess]
        _end_orphans()

    def start(self, task: Mapping[str, Any]) -> None:
        """Send the task, and wait until its own program runs.

        Raises:
            Ended: it did not start; the message is for the teacher.
        """
        self.exchange(task, time.monotonic() + _START_S, _START_S)

    def exchange(
        self, message: Mapping[str, Any] | None, deadline: float, limit_s: float
    ) -> dict[str, Any]:
        """Send a message, if there is one, and wait for one.

        Args:
            message: Data.
            deadline: On ``time.monotonic``; then the process is ended.
            limit_s: The limit as it is said.

        Raises:
            Ended: it ended, was ended, or sent something else.
        """
        to_send = memoryview(b"" if message is None else encode(message))
        watched = time.monotonic()
        with selectors.DefaultSelector() as selector:
            if to_send:
                selector.register(self._input, selectors.EVENT_WRITE)
            selector.register(self._output, selectors.EVENT_READ)
            if self._error >= 0:
                selector.register(self._error, selectors.EVENT_READ)
            while True:
                rest = deadline - time.monotonic()
                if rest <= 0:  # also where one message follows the other
                    self.end()
                    raise Ended(endless(limit_s).prop, "", endless(limit_s).detail)
                if document := self._document():
                    break
                for key, _ in selector.select(min(rest, _WATCH_S)):
                    if key.fd == self._input:
                        to_send = self._send(to_send, selector)
                    elif key.fd == self._error:
                        self._hear_errors(selector)
                    elif not self._receive():
                        raise self._ended()
                if time.monotonic() - watched > _WATCH_S:
                    watched = time.monotonic()
                    self._check_use()
        try:
            answer = decode(document)
        except DataError as e:
            raise Ended("it returns plain values", "", str(e)) from None
        if not isinstance(answer, dict):
            raise Ended("it returns plain values", "", "its process sent something else")
        return answer

    def _send(self, rest: memoryview, selector: selectors.BaseSelector) -> memoryview:
        try:
            rest = rest[os.write(self._input, rest[: 1 << 20]) :] if rest else rest
        except BlockingIOError:
            return rest
        except BrokenPipeError:
            rest = rest[:0]  # what it says at its end is still to be read
        if not rest:
            selector.unregister(self._input)
        return rest

    def _hear_errors(self, selector: selectors.BaseSelector) -> None:
        """Keep the end of what it says on errors."""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._error, 1 << 16)
            self._errors = (self._errors + data)[-_ERROR_BYTES:]
            if not data:
                selector.unregister(self._error)
                self._error = -1

    def _receive(self) -> bool:
        """Add what it sent; false at its end."""
        try:
            data = os.read(self._output, 1 << 20)
        except BlockingIOError:
            return True
        self._received += data
        return bool(data)

    def _document(self) -> bytearray:
        """The first message without its length; empty until it is whole."""
        if len(self._received) < LENGTH.size:
            return bytearray()
        (length,) = LENGTH.unpack_from(self._received)
        if length > LARGEST_BYTES:
            raise Ended("it returns plain values", "", f"it returned {length:,} bytes")
        end = LENGTH.size + length
        if len(self._received) < end:
            return bytearray()
        document = self._received[LENGTH.size : end]
        del self._received[:end]
        return document

    def _ended(self) -> Ended:
        """Why there will be no answer."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        code = self._process.poll()
        self.end()
        lines = self._errors.decode(errors="replace").strip().splitlines()
        if code is None:
            how = "it closed the line to the judge"
        elif code < 0 or code > 128:
            number = -code if code < 0 else code - 128
            name = signal.Signals(number).name if number in signal.valid_signals() else number
            how = f"its process was ended by {name}"
        else:
            how = f"its process ended with exit status {code}"
        return Ended("it returns an answer", "", f"{how}{f': {lines[-1]}' if lines else ''}")

    def _check_use(self) -> None:
        """End it if it and all that it started are too many, or use more memory than allowed."""
        processes = _descendants(self._process.pid)
        if len(processes) > _MOST_PROCESSES:
            self.end()
            raise Ended("it runs", "", f"it started more than {_MOST_PROCESSES} processes")
        if sum(map(_memory_of, processes)) >> 20 > self._memory_mb:
            self.end()
            most = f"{self._memory_mb:,} MB"
            raise Ended("it runs", "", f"it used more than {most} of memory")


def _children(pid: int) -> list[int]:
    """Processes that a process started, as far as the system tells."""
    children = []
    with contextlib.suppress(OSError):
        for task in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{task}/children") as file:
                children += [int(child) for child in file.read().split()]
    return children


def _descendants(pid: int) -> list[int]:
    """A process, and those that it and its children started."""
    processes = [pid]
    for each in processes:
        if len(processes) <= _MOST_PROCESSES:
            processes += _children(each)
    return processes


def _memory_of(pid: int) -> int:
    """Bytes that a process has in memory, and in files in memory that it holds open; shared ones
    are divided between processes. 0 where the system does not tell."""
    total = 0
    with contextlib.suppress(OSError), open(f"/proc/{pid}/smaps_rollup") as file:
        total += next((int(line.split()[1]) << 10 for line in file if line[:4] == "Pss:"), 0)
    with contextlib.suppress(OSError), os.scandir(f"/proc/{pid}/fd") as entries:
        for entry in entries:
            if os.readlink(entry.path).startswith("/memfd:"):
                total += entry.stat().st_blocks * 512
    return total


_IS_REAPER = False


def become_reaper() -> None:
    """What a submission starts and leaves belongs to this process from now on, which ends it (on
    Linux). For a process that does nothing but judge."""
    global _IS_REAPER
    if sys.platform.startswith("linux"):
        prctl = ctypes.CDLL(None).prctl
        _IS_REAPER = prctl(36, 1, 0, 0, 0) == 0  # PR_SET_CHILD_SUBREAPER
        prctl(4, 0, 0, 0, 0)  # PR_SET_DUMPABLE: its memory is closed to others of this user
        prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG: it ends with the program
    program = multiprocessing.parent_process()
    if program is not None and not program.is_alive():  # it ended before that
        os._exit(1)


def _end_orphans() -> None:
    while _IS_REAPER and (children := _children(os.getpid())):
        for child in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(child, 0)
