"""The sandbox's program: for each task it runs what a function of a submission needs, and calls it as often as asked.

``grading/isolated.py`` starts it with an installation without solutions, once for each student.
"""

import ast
import builtins
import contextlib
import importlib
import inspect
import linecache
import os
import pickle
import resource
import socket
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...backends import use_backend
from ...mapping import GSFusion
from ...optim import Keyframe
from ...types import Frame
from .messages import ChannelClosed, CodecError, encode, receive, send
from .needed import Cell, NoFunction, needed

_LARGEST_REQUEST = 1 << 30
_LONGEST = 300
"""Characters of a message."""
_TEACHING = __name__.rsplit(".", 2)[0]
_READY = ("gsfusion_nb.seeding", "gsfusion_nb.tracking", "gsfusion_nb.course.wall")
"""Imported before the first task, so that a task begins at once."""
_LARGEST_FILE = 64 << 20
_MORE_TASKS = 64
"""Processes and threads that a submission may have beside those that are there."""


class Line:
    """The connection to the grader, from the sandbox's side."""

    def __init__(self, to: socket.socket):
        self._to = to

    def say(self, *message: Any) -> None:
        """Send a message of values that ``codec`` knows."""
        send(self._to, encode(message))

    def hear(self) -> Any:
        """The grader's next message."""
        return pickle.loads(receive(self._to, largest=_LARGEST_REQUEST))

    def ask(self, *message: Any) -> Any:
        """Send a question and return the answer.

        Raises:
            RuntimeError: the grader refuses; the message says why.
        """
        self.say(*message)
        kind, value = self.hear()
        if kind == "refused":
            raise RuntimeError(value)
        return value


def main(fd: int, memory_bytes: int, cpu_s: int) -> None:
    """Serve the functions of one student, each in a process of its own, until the socket ``fd`` is closed.

    After each it says ``ended`` and the signal that ended the process, or 0.
    """
    to = socket.socket(fileno=fd)
    line = Line(to)
    torch.set_num_threads(1)
    for name in _READY:
        importlib.import_module(name)
    line.say("started")
    with contextlib.suppress(ChannelClosed):
        while True:
            task = line.hear()
            if task == ("done",):  # for a function whose process had ended
                continue
            process = os.fork()
            if process == 0:
                _limit(memory_bytes, cpu_s)
                _serve(line, task)
                os._exit(0)
            _, status = os.waitpid(process, 0)
            line.say("ended", os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0)


def _limit(memory_bytes: int, cpu_s: int) -> None:
    """Limits of this process and of each that it starts: memory beyond what it has now, processor time (SIGXCPU ends
    it), the size of files; and how many processes and threads its user may have, which no system asks of root."""
    limits = {"CPU": (cpu_s, cpu_s + 1), "CORE": (0, 0), "FSIZE": (_LARGEST_FILE, _LARGEST_FILE)}
    if sys.platform.startswith("linux"):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + memory_bytes
        tasks = sum(_threads(Path(folder)) for folder in Path("/proc").glob("[0-9]*")) + _MORE_TASKS
        limits |= {"AS": (most, most), "NPROC": (tasks, tasks)}
    for kind, values in limits.items():
        with contextlib.suppress(ValueError, OSError):  # one that is lower already
            resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), values)


def _threads(process: Path) -> int:
    """Threads of a process of this user; 0 for others and those that have ended."""
    try:
        return len(list((process / "task").iterdir())) if process.stat().st_uid == os.getuid() else 0
    except OSError:
        return 0


def _serve(line: Line, task: dict[str, Any]) -> None:
    """Serve one function until the grader has no more calls."""
    with contextlib.suppress(ChannelClosed):
        cells = [Cell(label, source) for label, source in task["cells"]]
        function = _defined(line, cells, task["name"], frozenset(task["accepted"]))
        if function is None:
            return
        line.say("ready", _parameters(function))
        while True:
            kind, *rest = line.hear()
            if kind == "done":
                return
            _call(line, function, rest[0], rest[1], cells)


def _defined(line: Line, cells: list[Cell], name: str, accepted: frozenset[str]) -> Callable[..., Any] | None:
    """The submission's function; ``None`` after the grader was told why there is none."""
    try:
        statements = needed(cells, name)
    except NoFunction as e:
        line.say("problem", "it is defined", str(e))
        return None
    _stand_in(line, name, accepted)
    main = types.ModuleType("__main__")
    main.__dict__["__builtins__"] = builtins
    sys.modules["__main__"] = main
    for cell in cells:
        linecache.cache[cell.label] = (len(cell.source), None, cell.source.splitlines(keepends=True), cell.label)
    try:
        with use_backend("reference"):
            for statement in statements:
                module = ast.Module(body=[statement.node], type_ignores=[])
                exec(compile(module, statement.cell.label, "exec"), main.__dict__)
    except BaseException as e:
        line.say("problem", "the lines that it needs run", _raised(e, cells), _is_memory(e))
        return None
    function = main.__dict__.get(name)
    if not callable(function):
        line.say("problem", "it is a function", f"{name} is a {type(function).__name__}")
        return None
    return function


def _stand_in(line: Line, judged: str, accepted: frozenset[str]) -> None:
    """What ``check.<other>.working(f)`` gives: f if the grader has accepted it, else the reference's, far away."""

    def working(name: str, function: Any) -> Any:
        if name == judged or name in accepted:
            return function

        def reference(*args: Any, **kwargs: Any) -> Any:
            return line.ask("reference", name, args, kwargs)

        return reference

    vars(sys.modules[_TEACHING])["working_of"] = working  # teaching is stand_in.py here


def _call(line: Line, function: Callable[..., Any], args: list[Any], kwargs: dict[str, Any], cells: list[Cell]) -> None:
    """Call the function once and send what it returned, and which arguments it changed."""
    mappers = [i for i, value in enumerate(args) if isinstance(value, tuple) and value[:1] == ("mapper",)]
    try:
        given = [_received(line, value, args, mappers) for value in args]
        before = [_copy(value) for value in given]
        with use_backend("reference"):
            result = function(*given, **kwargs)
        changed = [[i, v] for i, (v, old) in enumerate(zip(given, before, strict=True)) if _differs(v, old)]
        line.say("returned", result, changed, _states(given, mappers))
    except CodecError as e:
        line.say("problem", "it returns what the function's first line asks for", f"it returned {e}")
    except NotImplementedError:
        line.say("not written")
    except ChannelClosed:
        raise
    except BaseException as e:
        line.say("raised", _raised(e, cells), _is_memory(e))


def _received(line: Line, value: Any, args: list[Any], mappers: list[int]) -> Any:
    """An argument: a mapper from its state, a function of the grader as one that asks it, others as they are."""
    if isinstance(value, tuple) and value[:1] == ("mapper",):
        _, config, state = value
        args[mappers[0]] = GSFusion(config) if state is None else GSFusion.from_state_dict(state)
        return args[mappers[0]]
    if isinstance(value, tuple) and value[:1] == ("ask",):

        def ask(*inner: Any) -> Any:
            sent = [_view(v) for v in inner]
            return line.ask("callback", value[1], sent, _states(args, mappers))

        return ask
    return value


def _view(value: Any) -> Any:
    if isinstance(value, (Frame, Keyframe)):
        return ("view", "keyframe" if isinstance(value, Keyframe) else "frame", value.index)
    return value


def _states(args: list[Any], mappers: list[int]) -> list[Any]:
    """Position and state of each mapper in which something has been fused."""
    return [[i, args[i].state_dict()] for i in mappers if isinstance(args[i], GSFusion) and args[i].volume.n_blocks]


def _copy(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.clone()
    return value.copy() if isinstance(value, np.ndarray) else None


def _differs(value: Any, before: Any) -> bool:
    if isinstance(before, Tensor):
        return not torch.equal(value.nan_to_num(), before.nan_to_num())
    return isinstance(before, np.ndarray) and not np.array_equal(value, before, equal_nan=before.dtype.kind == "f")


def _parameters(function: Callable[..., Any]) -> list[list[Any]] | None:
    """Name, kind and default of each parameter."""
    try:
        found = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    return [[p.name, int(p.kind), p.default is not p.empty, _default(p.default)] for p in found]


def _default(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else None


def _raised(error: BaseException, cells: list[Cell]) -> str:
    """``it raised ValueError in line 3 of cell 7, `u = x / z`: message``."""
    labels = {cell.label for cell in cells}
    trace, place = error.__traceback__, ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if file in labels:
            text = linecache.getline(file, trace.tb_lineno).strip()
            place = f" in line {trace.tb_lineno} of {file}, `{text}`"
        trace = trace.tb_next
    said = str(error).splitlines()[0] if str(error) else ""
    return f"it raised {type(error).__name__}{place}: {said}"[:_LONGEST]


def _is_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error)
