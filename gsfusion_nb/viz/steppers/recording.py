"""Recording plain functions while they run: which line ran, and what chosen expressions were after
it.

A stepper shows these numbers. They are those of the program and not of a copy of it, and the text
of the line is read from the file, so neither can differ from the code.
"""

import ast
import functools
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import torch

from ...backends import use_backend
from ...errors import ArgumentError

RETURNED = "return"
"""Name of the value that a function returned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """One statement that ran, and the watched values after it."""

    function: str
    """Name of the function that it belongs to."""
    call: int
    """Which call of this function, from 0."""
    path: Path
    first: int
    """Number of its first line in the file, from 1."""
    last: int
    """Number of its last line."""
    values: Mapping[str, Any]
    """Watched expression -> value after the statement. Expressions with names that are not yet
    defined are missing."""

    @property
    def text(self) -> str:
        """The statement as it is in the file, on one line."""
        return " ".join(line.strip() for line in file_lines(self.path)[self.first - 1 : self.last])

    @property
    def place(self) -> str:
        """File and line, from the folder of the package on."""
        parts = self.path.parts
        return (
            f"{'/'.join(parts[len(parts) - 1 - parts[::-1].index('gsfusion_nb') :])}:{self.first}"
        )

    def __getitem__(self, expression: str) -> Any:
        return self.values[expression]


class Recording(list[Line]):
    """The lines that ran, in the order in which they ended, and ``result``, what the recorded call
    returned."""

    def __init__(self, lines: Iterable[Line], result: Any):
        super().__init__(lines)
        self.result = result

    def at(self, part: str) -> list[Line]:
        """The lines whose text contains ``part``.

        Raises:
            ValueError: no line that ran contains it.
        """
        matches = [line for line in self if part in line.text]
        if not matches:
            raise ArgumentError(f"no line that ran contains {part!r}")
        return matches


Watch = Mapping[Callable[..., Any], Mapping[str, Sequence[str]]]
"""Any function of a file -> name of a function in that file -> expressions, evaluated in its frame
after each line."""


def record(run: Callable[[], Any], watch: Watch) -> Recording:
    """Call ``run`` on the plain reference, and record each line of the watched functions."""
    recorder = _Recorder(watch)
    outer_trace = sys.gettrace()
    with use_backend("reference"):
        sys.settrace(recorder.enter)
        try:
            result = run()
        finally:
            sys.settrace(outer_trace)
    return Recording(recorder.lines, result)


class _Recorder:
    """Trace function of ``record``."""

    def __init__(self, watch: Watch):
        self.lines: list[Line] = []
        self._expressions: dict[tuple[str, str], list[tuple[str, CodeType]]] = {}
        self._pending: dict[FrameType, int] = {}
        self._calls: dict[CodeType, int] = {}
        self._number: dict[FrameType, int] = {}
        for anyone, functions in watch.items():
            file = str(inspect.getsourcefile(inspect.unwrap(anyone)))
            for name, expressions in functions.items():
                self._expressions[file, name] = [
                    (e, compile(e, "<watched>", "eval")) for e in expressions
                ]

    def enter(self, frame: FrameType, event: str, _argument: Any) -> Any:
        code = frame.f_code
        if event != "call" or (code.co_filename, code.co_name) not in self._expressions:
            return None
        self._number[frame] = self._calls.get(code, 0)
        self._calls[code] = self._number[frame] + 1
        return self._line

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            current = statement(frame.f_code.co_filename, frame.f_lineno)
            previous = self._pending.get(frame)
            if previous is not None and statement(frame.f_code.co_filename, previous) != current:
                self._end(frame, {})
            self._pending[frame] = frame.f_lineno
        elif event == "return" and frame in self._pending:
            self._end(frame, {RETURNED: _copy(argument)})
            del self._pending[frame], self._number[frame]
        return self._line

    def _end(self, frame: FrameType, values: dict[str, Any]) -> None:
        code = frame.f_code
        for expression, code_object in self._expressions[code.co_filename, code.co_name]:
            try:
                values[expression] = _copy(eval(code_object, frame.f_globals, frame.f_locals))
            except NameError:  # not yet defined
                continue
        first, last = statement(code.co_filename, self._pending[frame])
        path = Path(code.co_filename)
        call = self._number[frame]
        line = Line(
            function=code.co_name,
            call=call,
            path=path,
            first=first,
            last=last,
            values=values,
        )
        self.lines.append(line)


@functools.cache
def file_lines(path: Path) -> tuple[str, ...]:
    """The lines of a file."""
    return tuple(path.read_text(encoding="utf-8").splitlines())


def statement(file: str, line: int) -> tuple[int, int]:
    """First and last line of the statement at ``line``; of one with a body, such as a loop, only
    its head."""
    return _statements(file).get(line, (line, line))


@functools.cache
def _statements(file: str) -> dict[int, tuple[int, int]]:
    spans: dict[int, tuple[int, int]] = {}
    for first, last in sorted(
        _spans(ast.parse("\n".join(file_lines(Path(file))))),
        key=lambda s: s[0] - s[1],
    ):
        for line in range(first, last + 1):
            spans[line] = (first, last)  # the smallest span comes last
    return spans


def _spans(tree: ast.AST) -> Iterator[tuple[int, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            last = (
                body[0].lineno - 1
                if isinstance(body, list) and body
                else node.end_lineno or node.lineno
            )
            yield node.lineno, max(last, node.lineno)


def _copy(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, (list, tuple)) and not hasattr(value, "_fields"):
        return type(value)(_copy(v) for v in value)
    return value
