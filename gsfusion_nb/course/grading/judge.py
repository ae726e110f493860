"""The judge of a submission: the checkers of the course on a function in another process.

Everything that the judge knows, the right answers and the checkers, is in its process only. To the
submission go the arguments of one call after the other, and what it returns comes back as data.
"""

import inspect
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from ...backends import use_backend
from ...errors import ArgumentError
from ..attempt import Answer, Failed, NotWritten
from ..exercise import exercises
from ..learner_code import LIMIT_S
from ..verdict import Verdict
from .data import LONGEST_WORDS, DataError, cut
from .library import library_for
from .pickled import Outgoing
from .process import SubmissionProcess
from .sandbox import start_of
from .submission import Cell

_GRACE_S = 5.0
_TYPES = {"int": int, "float": float, "bool": bool, "str": str}


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one exercise of one submission."""

    seconds: float = 120.0
    """For all calls of its function, on the clock. One call may take as long as in a notebook."""
    memory_mb: int = 4096
    """Of its processes together, with Python and torch."""


class RemoteSubject:
    """A student's function in another process, as an ``Attempt`` calls it."""

    def __init__(self, process: SubmissionProcess, limits: Limits, goes_on_with: Sequence[str]):
        self._process = process
        self._limits = limits
        self._goes_on_with = goes_on_with
        self._rest_s = limits.seconds
        self._parameters: list[inspect.Parameter] = []

    def define(self) -> None:
        """Wait until the function is defined.

        Raises:
            Failed: its lines do not run or do not end, or it is no function.
        """
        reply = self._exchange(None, None)
        if not isinstance(reply.get("defined"), list):
            raise Failed("it is a function", "", f"got a {cut(reply.get('kind'), 80)}")
        self._parameters = _parameters(reply["defined"])

    @property
    def function(self) -> Callable[..., Any]:
        """A function of the same signature that calls it."""

        def call(*args: Any, **kwargs: Any) -> Any:
            return self.answer(args, kwargs).value

        signature = inspect.Signature(self._parameters)
        call.__signature__ = signature  # pyright: ignore[reportFunctionMemberAccess]
        return call

    def answer(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Answer:
        """Call it in its process."""
        outgoing = Outgoing(args, kwargs)
        seed = zlib.crc32(bytes(torch.get_rng_state().numpy()))
        reply = self._exchange({**outgoing.message, "seed": seed}, outgoing)
        if "not_written" in reply:
            raise NotWritten
        try:
            outgoing.take_back(reply["changes"])
            answer = Answer(
                value=reply["value"],
                callees={cut(k, 200): cut(v, 200) for k, v in reply["callees"].items()},
                borrowed={int(k): cut(v, 200) for k, v in reply["borrowed"].items()},
            )
        except DataError as e:
            raise Failed("it does not change its inputs", "", str(e)) from None
        except (KeyError, TypeError, ValueError, AttributeError):
            raise Failed("it runs", "", "its process sent something else than an answer") from None
        if reply.get("drew"):  # it drew from torch's global generator, and so does this process
            torch.rand(1)
        return answer

    def _exchange(
        self, message: Mapping[str, Any] | None, outgoing: Outgoing | None
    ) -> dict[str, Any]:
        """Its reply to a message, after what it asks in between.

        Raises:
            Failed: what it says, or it did not end in time.
        """
        began = time.monotonic()
        one_call_s = LIMIT_S + _GRACE_S  # in its process such a call ends with a better message
        limit_s = LIMIT_S if one_call_s < self._rest_s else self._limits.seconds
        deadline = began + min(one_call_s, self._rest_s)
        try:
            reply = self._process.exchange(message, deadline, limit_s)
            while "call" in reply or "reference" in reply:
                said = self._answer_question(reply, outgoing)
                reply = self._process.exchange(said, deadline, limit_s)
        except DataError as e:  # an answer of the judge that cannot cross
            raise Failed("it runs", "", str(e)) from None
        finally:
            self._rest_s -= time.monotonic() - began
        if "failed" in reply:
            failed = reply["failed"]
            texts = failed if isinstance(failed, list) else [failed]
            words = [cut(text) for text in texts]
            name = words[0] if words else ""
            detail = words[1] if len(words) > 1 else ""
            raise Failed(name, "", detail)
        return reply

    def _answer_question(
        self, question: Mapping[str, Any], outgoing: Outgoing | None
    ) -> dict[str, Any]:
        """The value of a function that was passed, or of an exercise on which this one builds."""
        try:
            if "reference" in question:
                name = question["reference"]
                if name not in self._goes_on_with:
                    return {"error": "this exercise does not build on it"}
                solution = exercises()[name]._solution
                return {"value": solution(*question["args"], **question["kwargs"])}
            if outgoing is None:
                return {"error": "no function was passed"}
            return {"value": outgoing.call(question["call"], question["args"])}
        except Exception as e:  # with arguments of a stranger
            return {"error": f"{type(e).__name__}: {e}"[:LONGEST_WORDS]}


def _parameters(shown: Sequence[Any]) -> list[inspect.Parameter]:
    """The signature that a submission says its function has."""
    try:
        parameters = []
        for name, kind, *annotation, default in shown:
            parameter = inspect.Parameter(
                name,
                inspect._ParameterKind(kind),
                default=default[0] if default else inspect.Parameter.empty,
                annotation=_TYPES[annotation[0]] if annotation else inspect.Parameter.empty,
            )
            parameters.append(parameter)
        inspect.Signature(parameters)
    except (ValueError, TypeError, KeyError, IndexError) as e:
        raise Failed("it is a function", "", f"its arguments cannot be read: {e}") from None
    return parameters


def check_system() -> None:
    """Refuse a system on which no submission can be judged.

    Raises:
        ValueError: it has no processes of the kind that is needed.
    """
    if find_spec("resource") is None:
        raise ArgumentError("grading needs Linux, macOS, or the Windows Subsystem for Linux")


def judge(name: str, cells: Sequence[Cell], limits: Limits, library: Path) -> Verdict:
    """The verdict on the function of an exercise in the cells of a submission; nothing is kept.

    Args:
        name: The exercise.
        cells: Code of the student.
        limits: Of time and memory.
        library: The copy of the package without solutions (``copy_library``).

    Raises:
        ValueError: this system has no processes of the kind that is needed.
    """
    check_system()
    exercise = exercises()[name]
    task = {
        "name": name,
        "cells": [[cell.label, cell.source] for cell in cells],
        "goes_on_with": list(exercise.goes_on_with),
        "memory_mb": limits.memory_mb,
    }
    with tempfile.TemporaryDirectory(prefix="gsnb-grade-", ignore_cleanup_errors=True) as folder:
        start = start_of(library_for(exercise, library), Path(folder), memory_mb=limits.memory_mb)
        process = SubmissionProcess(start, memory_mb=limits.memory_mb)
        with process, use_backend("reference"):
            try:
                process.start(task)
                subject = RemoteSubject(process, limits, exercise.goes_on_with)
                subject.define()
                verdict = exercise.verdict_on(subject)
            except Failed as e:
                verdict = Verdict(exercise=name, state="failed", prop=e.prop, detail=e.detail)
    return replace(
        verdict,
        prop=cut(verdict.prop),
        on=cut(verdict.on),
        detail=cut(verdict.detail),
    )
