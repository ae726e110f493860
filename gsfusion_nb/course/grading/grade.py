"""Grading a class: each function in a process of its own, several at a time, each mark kept as soon
as it is known."""

import contextlib
import multiprocessing
import os
import platform
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import torch

from ...resources import usable_cores
from ..exercise import exercises
from ..verdict import Verdict
from .data import cut
from .journal import Journal, mark_key
from .judge import Limits, check_system, judge
from .library import copy_library, grader_digest
from .marks import Mark, mark_of
from .process import become_reaper
from .sandbox import bubblewrap
from .submission import Cell, Submission, choose, read_code

_JUDGE_S = 300.0
"""For the start of a process and for what the judge itself computes, beside the time of the
function."""


@dataclass(frozen=True, kw_only=True)
class _Item:
    """One function to mark."""

    place: tuple[int, int]
    """Of the student in the class, and of the exercise in the course."""
    student: str
    exercise: str
    cells: tuple[Cell, ...] | None
    """``None``: it was not handed in, and ``problem`` says why."""
    problem: str


def grade(
    submissions: Sequence[Submission],
    names: Sequence[str],
    *,
    limits: Limits,
    jobs: int = 0,
    journal: Journal | None = None,
    tell: Callable[[str], None] = lambda line: None,
    keep: Callable[[list[Mark]], None] = lambda marks: None,
) -> list[Mark]:
    """The marks of all students, by student and in the order of the course.

    Args:
        submissions: Of each student.
        names: Exercises, in the order of the course.
        limits: Of each function.
        jobs: Functions at the same time; 0: one for each core, at most 8.
        journal: What an earlier grading found is taken from it, and what this one finds is added.
        tell: Gets a line for each student.
        keep: Gets all marks so far, in order, whenever there is one more.

    Raises:
        ValueError: this system cannot judge a submission.
        OSError: this machine could not, for example because its disk is full.
    """
    check_system()
    items = [
        item for i, submission in enumerate(submissions) for item in _items(i, submission, names)
    ]
    earlier = {} if journal is None else journal.read()
    grader = f"{grader_digest()} {torch.__version__} {platform.python_version()} {bubblewrap()}"
    marks: dict[tuple[int, int], Mark] = {}
    lock = threading.Lock()

    def done(item: _Item, mark: Mark) -> None:
        with lock:
            marks[item.place] = mark
            in_order = [marks[place] for place in sorted(marks)]
            keep(in_order)
            own = [marks[i.place] for i in items if i.student == item.student and i.place in marks]
            if len(own) == len(names):
                points = sum(m.points for m in own)
                most = sum(m.most for m in own)
                tell(f"{item.student}: {points:g} of {most:g} points")

    with tempfile.TemporaryDirectory(prefix="gsnb-library-", ignore_cleanup_errors=True) as folder:
        library = copy_library(Path(folder) / "library")

        def mark(item: _Item, judges: _Judges) -> None:
            key = mark_key(item.student, item.exercise, item.cells, limits, grader)
            if key in earlier:
                done(item, earlier[key])
                return
            began = time.monotonic()
            verdict = judges.verdict(item)
            seconds = round(time.monotonic() - began, 1)
            new = mark_of(item.student, item.exercise, verdict, seconds)
            if journal is not None:
                journal.add(key, new)
            done(item, new)

        with _Judges(limits, library) as judges:
            pool = ThreadPoolExecutor(jobs or min(usable_cores(), 8))
            try:
                for _ in pool.map(lambda item: mark(item, judges), items):
                    pass
            finally:
                pool.shutdown(cancel_futures=True)
    return [marks[place] for place in sorted(marks)]


def _items(number: int, submission: Submission, names: Sequence[str]) -> Iterator[_Item]:
    """The functions of one student."""
    codes = [read_code(file) for file in submission.files]
    problem = next((code.problem for code in codes if code.problem), "")
    files = ", ".join(code.file.name for code in codes)
    for place, name in enumerate(names):
        code = choose(codes, name, exercises()[name].chapter)
        yield _Item(
            place=(number, place),
            student=submission.student,
            exercise=name,
            cells=None if code is None else code.cells,
            problem=problem or f"there is no function {name} in {files}",
        )


class _Judges:
    """Processes that judge, one for each thread that asks. One that is ended by a submission, which
    is possible without bubblewrap, is replaced."""

    def __init__(self, limits: Limits, library: Path):
        self._limits = limits
        self._library = library
        self._longest_s = limits.seconds + _JUDGE_S
        self._of_thread = threading.local()
        self._every: list[ProcessPoolExecutor] = []

    def __enter__(self) -> "_Judges":
        return self

    def __exit__(self, *_: object) -> None:
        for pool in self._every:
            pool.shutdown(cancel_futures=True)

    def _pool(self) -> ProcessPoolExecutor:
        """That of this thread, with one process."""
        if getattr(self._of_thread, "pool", None) is None:
            spawn = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=become_reaper)
            self._every.append(pool)
            self._of_thread.pid = pool.submit(os.getpid).result()
            self._of_thread.pool = pool
        return self._of_thread.pool

    def verdict(self, item: _Item) -> Verdict:
        """The verdict on one function."""
        if item.cells is None:
            return Verdict(
                exercise=item.exercise, state="failed", prop="it is submitted", detail=item.problem
            )
        arguments = (item.exercise, item.cells, self._limits, self._library)
        try:
            pool = self._pool()
            return pool.submit(judge, *arguments).result(self._longest_s)
        except BrokenProcessPool:
            self._of_thread.pool = None
            detail = "the process that marks it was ended while it ran"
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._of_thread.pid, signal.SIGKILL)
            self._of_thread.pool = None
            detail = (
                f"what it sent kept the process that marks it busy for more than "
                f"{self._longest_s:g} s"
            )
        except OSError:  # of this machine, not of the submission
            raise
        except Exception as e:
            detail = f"the judge could not go on: {type(e).__name__}: {e}"
        return Verdict(
            exercise=item.exercise,
            state="failed",
            prop="it returns an answer",
            detail=cut(detail),
        )
