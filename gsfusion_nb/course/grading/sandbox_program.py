"""The program of the sandbox: it defines functions of one submission and calls them as often as the grader asks.

``sandbox.py`` starts it in an installation without the solutions. Of a notebook, only the statements run that the
function needs: its definition, and what that uses, directly or not. So panels, long fits and a cell that raises do not
matter.
"""

import ast
import contextlib
import functools
import importlib
import inspect
import io
import linecache
import os
import pickle
import random
import re
import resource
import symtable
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...backends import use_backend
from ...mapping import GSFusion
from ...optim import Keyframe
from ...types import Frame, Seeds
from ..learner_code import Failed, argument_copy, plain_value

WITHIN = "it stays within the limits of time and memory"
_READY = ("gsfusion_nb.seeding", "gsfusion_nb.tracking", "gsfusion_nb.course.seeding_scene")
"""Imported before the first function, so that it begins at once."""
_LARGEST_FILE = 64 << 20
_MOST_PROCESSES = 4096
_LONGEST = 300
"""Characters of a message."""
_FRESH = (
    ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.Import, ast.ImportFrom,
)  # fmt: skip
_COMPREHENSIONS = ("listcomp", "setcomp", "dictcomp", "genexpr")
_MAGIC = re.compile(r"^(\s*)(%|!|\?)|^(\s*)[^#'\"]*\?\s*$")


@dataclass(frozen=True)
class Cell:
    """A code cell, or a file."""

    label: str
    """``cell 7``: 7 counts all cells of the notebook from 1; or the name of the file."""
    source: str


@dataclass(frozen=True, eq=False)
class Statement:
    """One statement at the top level of a cell."""

    node: ast.stmt
    cell: Cell
    position: int
    binds: frozenset[str]
    now: frozenset[str]
    """Names that it reads when it runs."""
    later: frozenset[str]
    """Names that functions in it read when they are called."""


def needed(cells: Sequence[Cell], name: str) -> list[Statement]:
    """The statements to run, in order, so that ``name`` is the submission's function; its last definition counts.

    Raises:
        Failed: it is not defined, or the cell that defines it has a syntax error.
    """
    statements, broken = _statements(cells)
    if not any(name in s.binds for s in statements):
        for cell, error in broken:
            if re.search(rf"\b{re.escape(name)}\b", cell.source):
                said = f"{cell.label} has a syntax error in line {error.lineno}, so nothing in it can run: {error.msg}"
                raise Failed("it is defined", "", said)
        raise Failed("it is defined", "", f"there is no function {name}")
    kept: dict[int, Statement] = {}
    names = [(name, len(statements))]
    seen = set(names)
    while names:
        wanted, before = names.pop()
        for statement in _binding(statements[:before], wanted):
            kept[statement.position] = statement
            more = [(n, statement.position) for n in statement.now] + [(n, len(statements)) for n in statement.later]
            names += [item for item in more if item not in seen]
            seen.update(more)
    return [kept[position] for position in sorted(kept)]


def _binding(statements: Sequence[Statement], name: str) -> Iterator[Statement]:
    """The last statements that give ``name`` its value, back to one that does not read it."""
    for statement in reversed(statements):
        if name in statement.binds:
            yield statement
            if name not in statement.now and isinstance(statement.node, _FRESH):
                return


def _statements(cells: Sequence[Cell]) -> tuple[list[Statement], list[tuple[Cell, SyntaxError]]]:
    found: list[Statement] = []
    broken = []
    for cell in cells:
        try:
            for node in ast.parse(plain_python(cell.source)).body:
                found.append(Statement(node, cell, len(found), *_names(node)))
        except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
            broken.append((cell, e if isinstance(e, SyntaxError) else SyntaxError(str(e) or type(e).__name__)))
    return found, broken


def plain_python(source: str) -> str:
    """A cell without IPython's own syntax; every line keeps its number."""
    lines = source.splitlines()
    if lines and lines[0].startswith("%%"):
        if not lines[0].startswith(("%%time", "%%capture")):
            return ""
        lines[0] = ""
    return "\n".join(re.sub(r"\S.*", "pass", line) if _MAGIC.match(line) else line for line in lines) + "\n"


def _names(node: ast.stmt) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Names that a statement binds, reads when it runs, and reads later; those inside functions are not global."""
    table = symtable.symtable(ast.unparse(node), "cell", "exec")
    binds = {s.get_name() for s in table.get_symbols() if s.is_assigned() or s.is_imported() or s.is_namespace()}
    now = {s.get_name() for s in table.get_symbols() if s.is_referenced()}
    later: set[str] = set()

    def visit(scope: symtable.SymbolTable, deferred: bool) -> None:
        deferred = deferred or (scope.get_type() == "function" and scope.get_name() not in _COMPREHENSIONS)
        used = {s.get_name() for s in scope.get_symbols() if s.is_referenced() and s.is_global()}
        (later if deferred else now).update(used)
        for inner in scope.get_children():
            visit(inner, deferred)

    for inner in table.get_children():
        visit(inner, False)
    return frozenset(binds), frozenset(now), frozenset(later)


def main(fd: int, memory_bytes: int, cpu_s: int) -> None:
    """Serve the functions of one student, one after the other, until the connection ``fd`` is closed.

    Args:
        fd: Of the connection. The grader sends pickled tuples; answers are saved by torch, without other objects.
        memory_bytes: Beyond what Python and the libraries take.
        cpu_s: Of processor time for each function.
    """
    grader = Connection(fd)
    torch.set_num_threads(1)
    for name in _READY:
        importlib.import_module(name)
    _limit(memory_bytes)
    function: SubmittedFunction | None = None
    _say(grader, "started")
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            kind, *rest = pickle.loads(grader.recv_bytes())
            try:
                if kind == "define":
                    used = resource.getrusage(resource.RUSAGE_SELF)
                    most = int(used.ru_utime + used.ru_stime) + 1 + cpu_s
                    resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))
                    function = SubmittedFunction(grader, *rest)
                    _say(grader, "ready", function.parameters)
                elif function is not None:
                    _say(grader, "returned", *function(*rest))
            except NotImplementedError:
                _say(grader, "not written")
            except Failed as e:
                _say(grader, "failed", e.prop, e.detail[:_LONGEST])


def _limit(memory_bytes: int) -> None:
    """Limits of this process and of each that it starts: memory beyond what it has now, size of files, processes."""
    limits = {"CORE": 0, "FSIZE": _LARGEST_FILE, "NPROC": _MOST_PROCESSES}
    if sys.platform.startswith("linux"):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits["AS"] = pages * resource.getpagesize() + memory_bytes
    for kind, most in limits.items():
        with contextlib.suppress(ValueError, OSError):  # one that is lower already
            resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (most, most))


def _say(grader: Connection, *message: Any) -> None:
    buffer = io.BytesIO()
    torch.save(message, buffer)
    grader.send_bytes(buffer.getbuffer())


class SubmittedFunction:
    """A function of a submission.

    Args:
        grader: Is asked for the values of functions that are arguments, and of references.
        cells: Label and source of each cell.
        name: Of the function.
        accepted: Exercises whose functions of the same submission were accepted: ``check.<other>.working(f)`` gives f
            for these, else the grader's reference.

    Raises:
        Failed: it is not defined, or what it needs raises.
    """

    def __init__(self, grader: Connection, cells: Sequence[tuple[str, str]], name: str, accepted: frozenset[str]):
        self.grader, self.name, self.accepted = grader, name, accepted
        self.cells = [Cell(label, source) for label, source in cells]
        self.mappers: dict[int, GSFusion] = {}
        torch.manual_seed(0)
        random.seed(0)
        self._stand_in()
        namespace = vars(types.ModuleType("__main__"))
        for cell in self.cells:
            linecache.cache[cell.label] = (len(cell.source), None, cell.source.splitlines(keepends=True), cell.label)

        statements = needed(self.cells, name)

        def run() -> None:
            for statement in statements:
                module = ast.Module(body=[statement.node], type_ignores=[])
                exec(compile(module, statement.cell.label, "exec"), namespace)

        self._guarded("the lines that it needs run", run)
        self.function = namespace.get(name)
        if not callable(self.function):
            raise Failed("it is a function", "", f"{name} is a {type(self.function).__name__}")

    @property
    def parameters(self) -> list[tuple[str, int, bool, Any]] | None:
        """Name and kind of each parameter, whether it has a default, and the default if it is a number or a text."""
        try:
            found = inspect.signature(self.function).parameters.values()  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError):
            return None
        defaults = (p.default if isinstance(p.default, (bool, int, float, str)) else None for p in found)
        return [(p.name, int(p.kind), p.default is not p.empty, d) for p, d in zip(found, defaults, strict=True)]

    def __call__(self, args: Sequence[Any], kwargs: dict[str, Any]) -> tuple[Any, bool, dict[int, Any]]:
        """What the function returns, whether it changed a tensor or an array that was passed in, and the mappers."""
        self.mappers = {}
        given = [self._received(i, value) for i, value in enumerate(args)]
        before = [argument_copy(value) for value in given]
        result = self._guarded("it runs", lambda: self.function(*given, **kwargs))  # pyright: ignore[reportOptionalCall]
        if result is None or result is Ellipsis:
            raise NotImplementedError
        changed = any(
            isinstance(old, Tensor) and not torch.equal(value.nan_to_num(), old.nan_to_num())
            for value, old in zip(map(torch_of, given), map(torch_of, before), strict=True)
        )
        value = {"Seeds": vars(result)} if isinstance(result, Seeds) else plain_value(result)
        return value, changed, self._states()

    def _guarded(self, prop: str, run: Callable[[], Any]) -> Any:
        try:
            with use_backend("reference"):
                return run()
        except NotImplementedError:
            raise
        except BaseException as e:
            if isinstance(e, MemoryError) or "can't allocate memory" in str(e):
                raise Failed(WITHIN, "", "it needed more memory than it may have: is a tensor far too large?") from None
            raise Failed(prop, "", self._raised(e)) from None

    def _raised(self, error: BaseException) -> str:
        """``it raised ValueError in line 3 of cell 7, `u = x / z`: message``."""
        labels = {cell.label for cell in self.cells}
        trace, place = error.__traceback__, ""
        while trace is not None:
            file = trace.tb_frame.f_code.co_filename
            if file in labels:
                place = f" in line {trace.tb_lineno} of {file}, `{linecache.getline(file, trace.tb_lineno).strip()}`"
            trace = trace.tb_next
        return f"it raised {type(error).__name__}{place}: {str(error).partition(chr(10))[0]}"

    def _received(self, position: int, value: Any) -> Any:
        """An argument: a mapper from its state, a function of the grader as one that asks it, others as they are."""
        if isinstance(value, tuple) and value[:1] == ("mapper",):
            _, config, state = value
            self.mappers[position] = GSFusion(config) if state is None else GSFusion.from_state_dict(state)
            return self.mappers[position]
        if isinstance(value, tuple) and value[:1] == ("function",):
            return lambda *inner: self._ask(value[1], [_view(v) for v in inner])
        return value

    def _ask(self, what: int | str, args: list[Any]) -> Any:
        """The value of a function of the grader: one that is an argument, or the reference of an exercise."""
        _say(self.grader, "ask", what, args, self._states())
        try:
            kind, value = pickle.loads(self.grader.recv_bytes())
        except (EOFError, ConnectionError):  # the grader has gone
            os._exit(0)
        if kind == "refused":
            raise RuntimeError(value)
        return value

    def _states(self) -> dict[int, Any]:
        """Position and state of each mapper in which something has been fused."""
        states = {i: m.state_dict() for i, m in self.mappers.items() if m.volume.n_blocks}
        return {i: {k: v for k, v in state.items() if k not in ("config", "rule")} for i, state in states.items()}

    def _stand_in(self) -> None:
        """Put names of ``gsfusion_nb.course`` there, of which notebooks make use; they do nothing."""
        course = sys.modules[__name__.rsplit(".", 2)[0]]
        vars(course).update(dict.fromkeys(("came", "course_progress", "mine", "predict"), _do_nothing))
        vars(course)["check"] = _Check(self)


class _Check:
    """``check`` of a notebook: no verdict, hint or solution; ``working`` gives a function to go on with."""

    def __init__(self, judged: SubmittedFunction):
        self._judged = judged

    def __getattr__(self, name: str) -> Any:
        def working(function: Any, *, plain: bool = False) -> Any:
            if name == self._judged.name or name in self._judged.accepted:
                return function
            return lambda *args: self._judged._ask(name, list(args))

        exercise = functools.partial(_do_nothing)
        vars(exercise).update(working=working, hint=_do_nothing, solution=_do_nothing)
        return exercise


def _do_nothing(*args: Any, **kwargs: Any) -> None: ...


def _view(value: Any) -> Any:
    if isinstance(value, (Frame, Keyframe)):
        return ("view", "keyframe" if isinstance(value, Keyframe) else "frame", value.index)
    return value


def torch_of(value: Any) -> Any:
    """An array as a tensor; other values as they are."""
    return torch.from_numpy(value) if type(value).__module__ == "numpy" and hasattr(value, "shape") else value
