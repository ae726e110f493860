"""The program of a submission's process: it defines one function of a student, and answers the
judge's calls of it.

``python -m gsfusion_nb.course.grading.answering``, with the copy of the package that has no
solutions. Nothing in this process is secret, and nothing that it says is believed but as an answer:
the judge, in another process, compares it.
"""

import ast
import ctypes
import inspect
import linecache
import os
import random
import signal
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any, BinaryIO

import numpy as np
import torch

from ...backends import use_backend
from ..attempt import Answer, LocalSubject, NotWritten
from ..learner_code import Failed, plain_value
from .data import LENGTH, DataError, cut, decode, encode
from .pickled import Incoming
from .submission import Cell, needed

_MOST_OF_USER = 2048
"""Processes and threads, so that a program that only starts others does not stop the machine."""
_ANNOTATIONS = {"int": int, "float": float, "bool": bool, "str": str}


class Judge:
    """The other end of the line."""

    def __init__(self, incoming: BinaryIO, outgoing: BinaryIO):
        self._incoming = incoming
        self._outgoing = outgoing

    def tell(self, **message: Any) -> None:
        """Send a message; what cannot be sent is said instead."""
        try:
            data = encode(message)
        except DataError as e:
            data = encode({"failed": ["it returns plain values", str(e)]})
        self._outgoing.write(data)
        self._outgoing.flush()

    def hear(self) -> Any:
        """The next message; the process ends where there is none."""
        head = self._incoming.read(LENGTH.size)
        if len(head) < LENGTH.size:
            os._exit(0)
        return decode(self._incoming.read(LENGTH.unpack(head)[0]))

    def ask(self, **question: Any) -> Any:
        """What the judge answers to a question; raises what it refuses."""
        self.tell(**question)
        reply = self.hear()
        if "error" in reply:
            raise RuntimeError(reply["error"])
        return reply["value"]


_LINE: list[Judge] = []
_GOES_ON_WITH: list[str] = []


def reference_of(exercise: str) -> Callable[..., Any] | None:
    """A function that the judge computes, or ``None`` where this exercise does not build on it."""
    if exercise not in _GOES_ON_WITH:
        return None

    def call(*args: Any, **kwargs: Any) -> Any:
        values = [plain_value(a) for a in args]
        keywords = {k: plain_value(a) for k, a in kwargs.items()}
        return _LINE[0].ask(reference=exercise, args=values, kwargs=keywords)

    return call


def main() -> None:
    """Define the function of the first message, then answer calls until the line is closed."""
    judge = Judge(os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb"))
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)  # what the student prints
    task = judge.hear()
    _LINE.append(judge)
    _GOES_ON_WITH.extend(task["goes_on_with"])
    torch.set_num_threads(1)
    judge.tell(ready=True, limits=_limit(task["memory_mb"]))
    with use_backend("reference"):
        function = _defined(judge, [Cell(*cell) for cell in task["cells"]], task["name"])
        while True:
            _answer(judge, function, judge.hear())


def _limit(memory_mb: int) -> list[str]:
    """Set the limits of this process and of those that it starts. Returns what is limited."""
    import resource

    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: it ends with the judge
    sizes = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: memory_mb << 20,
        resource.RLIMIT_NOFILE: 256,
        resource.RLIMIT_NPROC: _MOST_OF_USER,  # root has no such limit
    }
    for kind, most in sizes.items():
        usual = resource.getrlimit(kind)[1]
        most = most if usual == resource.RLIM_INFINITY else min(most, usual)
        resource.setrlimit(kind, (most, most))
    if not sys.platform.startswith("linux"):
        return []  # macOS takes a limit of memory and does not keep it
    with open("/proc/self/statm") as file:
        pages, resident, *_ = map(int, file.read().split())
    unused = (pages - resident) * resource.getpagesize()
    most = unused + (memory_mb << 20)  # all that is mapped, shared maps too
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    return ["memory"]


def _defined(judge: Judge, cells: Sequence[Cell], name: str) -> Any:
    """Define the function and say so, or say why not."""
    namespace: dict[str, Any] = vars(types.ModuleType("__main__"))
    torch.manual_seed(0)
    try:
        _run_cells(cells, name, namespace)
        function = namespace[name]
        what = _signature(function) if callable(function) else None
        judge.tell(defined=what, kind=type(function).__name__)
        return function
    except Failed as e:
        judge.tell(failed=[cut(e.prop), cut(e.detail)])
        return None


def _run_cells(cells: Sequence[Cell], name: str, namespace: dict[str, Any]) -> None:
    for cell, node in needed(cells, name):
        linecache.cache[cell.label] = (
            len(cell.source),
            None,
            cell.source.splitlines(keepends=True),
            cell.label,
        )
        try:
            exec(
                compile(ast.Module(body=[node], type_ignores=[]), cell.label, "exec"),
                namespace,
            )
        except Exception as e:
            detail = f"line {node.lineno} of {cell.label} raised {type(e).__name__}: {e}"
            raise Failed("the lines that it needs run", "", detail) from None


def _signature(function: Callable[..., Any]) -> list[list[Any]]:
    """Name, kind, type and default of each argument, as data; no argument where it has none to
    show."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    shown = []
    for p in parameters:
        types_ = [name for name, kind in _ANNOTATIONS.items() if p.annotation in (kind, name)]
        has_default = p.default is not inspect.Parameter.empty
        default = [p.default] if has_default else []
        shown.append([p.name, int(p.kind), *types_[:1], default])
    return shown


def _answer(judge: Judge, function: Any, message: Any) -> None:
    """Call the function once and tell what it gave."""
    inputs = Incoming(message, lambda n, args: judge.ask(call=n, args=plain_value(list(args))))
    torch.manual_seed(message["seed"])
    random.seed(message["seed"])
    np.random.seed(message["seed"] % 2**32)  # noqa: NPY002
    state = torch.get_rng_state()
    try:
        answer = LocalSubject(function).answer(inputs.args, inputs.kwargs)
    except NotWritten:
        judge.tell(not_written=True)
    except Failed as e:
        judge.tell(failed=[cut(e.prop), cut(e.detail)])
    else:
        judge.tell(**_told(answer, inputs), drew=not torch.equal(state, torch.get_rng_state()))


def _told(answer: Answer, inputs: Incoming) -> dict[str, Any]:
    return {
        "value": answer.value,
        "callees": dict(answer.callees),
        "borrowed": dict(answer.borrowed),
        "changes": inputs.changes(),
    }


if __name__ == "__main__":
    from gsfusion_nb.course.grading import answering  # one module, whoever imports it

    answering.main()
