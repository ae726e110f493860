"""The learner's accepted functions as a backend: ``with use_backend("mine")`` the library runs them.

In a notebook::

    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.course import mine

    check.l1_gradient(l1_gradient)       # accepted: kept for its exercise
    with use_backend("mine"):
        mapper.step(frame)               # the library's mapper, with your gradient of the loss
    mine.board()                         # whose code ran, how often, how long

An exercise says which operation, or which piece of one, its function becomes (``exercise(..., becomes=...)``). For
operations without a kept function the plain reference runs.
"""

import functools
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import torch
from markupsafe import Markup
from torch import Tensor

from ..backends import CALLS, FUNCTIONS, Calls, use_backend
from ..drawing.page import html_table
from .learner_code import Failed, functions_of_earlier_chapters, line_of_definition, line_of_error, plain_value

KEPT: dict[str, Callable[..., Any]] = {}
"""Exercise -> the learner's newest accepted function."""


@dataclass(frozen=True)
class Becomes:
    """What a function becomes under the backend ``mine``: an operation of the library, or a piece of one."""

    operation: str
    """Name of the function with ``@op`` or ``@piece``."""
    adapter: Callable[..., Any]
    """Takes the learner's function (``Yours``) and the arguments of the operation; returns what the operation returns,
    or ``NotImplemented`` to leave this call to the reference."""


class LearnerError(RuntimeError):
    """A learner's function failed inside the library; the message names its cell and line and what went in.

    Args:
        message: The sentence.
        exercise: Name of the exercise.
        where: Cell (or file) and line.
    """

    def __init__(self, message: str, exercise: str = "", where: str = ""):
        super().__init__(message)
        self.exercise, self.where = exercise, where


class Yours:
    """A learner's function inside the library, as the adapter of its exercise calls it.

    While it runs, the backend is the reference, so that a library function that it calls does not call it again.

    Args:
        exercise: Name of the exercise.
        operation: The operation of the library that the function replaces.
        function: The learner's function.
    """

    def __init__(self, exercise: str, operation: str, function: Callable[..., Any]):
        self.exercise, self.operation, self.function = exercise, operation, function

    def __call__(self, *args: Any, gives: Mapping[str, Tensor] | None = None) -> Any:
        """Call the function on copies of the tensors in ``args``.

        Args:
            gives: Name of each result -> a tensor of the shape and type that it must have. One result is returned as
                a tensor, several as a tuple. Without ``gives`` the result is returned as it is.

        Raises:
            LearnerError: the function raised, or a result has another shape or type, or is not finite.
        """
        copies = [value.clone() if isinstance(value, Tensor) else value for value in args]
        results = self._checked(self._called(copies), gives, args)
        self._check_finite(results, gives or {}, args)
        return results

    def many(self, calls: Sequence[tuple], gives: Sequence[Mapping[str, Tensor]]) -> list[Any]:
        """Call the function for each tuple of arguments, which are copies that nothing else uses.

        For functions of one pixel, which are called thousands of times: NaN is looked for in all results at once.

        Raises:
            LearnerError: as for one call.
        """
        results = [self._checked(self._called(args), like, args) for args, like in zip(calls, gives, strict=True)]
        values = [
            value.reshape(-1) for result in results for value in (result if isinstance(result, tuple) else [result])
        ]
        if values and not torch.cat(values).isfinite().all():
            for result, args, like in zip(results, calls, gives, strict=True):
                self._check_finite(result, like, args)
        return results

    def _check_finite(self, results: Any, gives: Mapping[str, Tensor], args: tuple) -> None:
        for name, value in zip(gives, results if len(gives) > 1 else (results,), strict=False):
            if not value.isfinite().all():
                bad = (~value.isfinite()).nonzero()
                at = f", the first at {bad[0].tolist()}" if value.ndim else ""
                self.fail(f"returned {len(bad)} NaN or infinite values for {name} {list(value.shape)}{at}", args)

    def _called(self, args: Sequence[Any]) -> Any:
        try:
            with use_backend("reference"):
                return plain_value(self.function(*args))
        except Failed as e:
            self.fail(e.detail, tuple(args), cause=e)
        except Exception as e:
            reason = f"{type(e).__name__}: {str(e).splitlines()[0]}" if str(e) else type(e).__name__
            self.fail(f"raised {reason}", tuple(args), cause=e)

    def _checked(self, result: Any, gives: Mapping[str, Tensor] | None, args: tuple) -> Any:
        if gives is None:
            return result
        values = result if len(gives) > 1 else (result,)
        if not isinstance(values, (tuple, list)) or len(values) != len(gives):
            self.fail(f"must return {len(gives)} results ({', '.join(gives)}); it returned {_short(result)}", args)
        checked = tuple(
            self._as_tensor(name, value, like, args) for (name, like), value in zip(gives.items(), values, strict=True)
        )
        return checked if len(gives) > 1 else checked[0]

    def _as_tensor(self, name: str, value: Any, like: Tensor, args: tuple) -> Tensor:
        """``value`` with the shape and type of ``like``; numbers and lists are converted."""
        if isinstance(value, Tensor) and value.shape == like.shape and value.dtype == like.dtype:
            return value
        expected = f"expected {_kind(like)}"
        try:
            got = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            self.fail(f"returned {_short(value)} for {name}, which is not an array of numbers; {expected}", args)
        is_whole = isinstance(value, Tensor) and not got.is_floating_point()
        if got.shape != like.shape or (like.is_floating_point() and (is_whole or got.is_complex())):
            self.fail(f"returned {_short(value)} for {name}; {expected}", args)
        return got.to(like)

    def fail(self, what: str, args: tuple = (), *, cause: Exception | None = None) -> NoReturn:
        """Raise ``LearnerError``: the function, its place, ``what`` it did, and the arguments that went in."""
        where = (cause is not None and line_of_error(cause, self.function)) or line_of_definition(self.function)
        message = f"your {self.exercise} ({where}) {what}. It ran as the operation {self.operation}"
        if args:
            names = list(inspect.signature(self.function).parameters)
            names += [f"argument {i + 1}" for i in range(len(names), len(args))]
            message += ", with " + "; ".join(f"{n} = {_short(v)}" for n, v in zip(names, args, strict=False))
        raise LearnerError(message, self.exercise, where) from cause


def _kind(tensor: Tensor) -> str:
    return f"{list(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"


def _short(value: Any) -> str:
    """A value in a few words: a small one in full, a tensor by shape, type and range."""
    if isinstance(value, (bool, int, float, str)) or value is None:
        return repr(value)
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}{f' of {len(value)}' if isinstance(value, (list, tuple)) else ''}"
    if value.numel() <= 4 and value.ndim <= 1:
        return str(value.tolist())
    words = _kind(value)
    finite = value[value.isfinite()].double()
    if finite.numel():
        words += f", {float(finite.min()):.4g} to {float(finite.max()):.4g}"
    missing = value.numel() - finite.numel()
    return words + (f", {missing} not finite" if missing else "")


def remember(exercise: str, becomes: Becomes | None, function: Callable[..., Any]) -> None:
    """Keep ``function`` for an exercise, in place of an earlier one."""
    KEPT[exercise] = function
    if becomes is not None:
        yours = Yours(exercise, becomes.operation, function)
        FUNCTIONS[becomes.operation] = functools.partial(becomes.adapter, yours)


def keep(exercise: str, function: Callable[..., Any]) -> None:
    """Use ``function`` for its exercise from now on, without a check; ``check.<exercise>(function)`` keeps what passes.

    The newest function counts. One whose exercise becomes no operation is kept, too, and runs nowhere.

    Raises:
        KeyError: there is no such exercise.
    """
    known = _exercises()
    if exercise not in known:
        raise KeyError(f"there is no exercise {exercise!r}")
    remember(exercise, known[exercise].becomes, function)


def load(*, missing: Literal["reference", "solution"] = "reference", chapters: Collection[int] | None = None) -> None:
    """Use the functions that were accepted in earlier chapters, too, from the course file.

    They are checked again, because the file can be edited; one that fails is named, and not used.

    Args:
        chapters: Only exercises of these chapters; those of others run as they are kept now. Default: all.
        missing: What runs for an exercise without an accepted function: the reference, or the course's solution, which
            the board shows as such.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    known = {name: e for name, e in _exercises().items() if chapters is None or e.chapter in chapters}
    for name, function in functions_of_earlier_chapters().items():
        if name in known and name not in KEPT:
            verdict = known[name].verdict(function)
            if verdict:
                keep(name, function)
            else:
                verdict.code_in_use.tell()
    for name, exercise in known.items():
        if missing == "solution" and name not in KEPT:
            keep(name, exercise._solution)


def forget(*names: str) -> None:
    """Forget the functions of these exercises, or of all; the reference runs again in their place."""
    known = _exercises()
    for name in names or tuple(KEPT):
        KEPT.pop(name, None)
        becomes = known[name].becomes if name in known else None
        if becomes is not None:
            FUNCTIONS.pop(becomes.operation, None)


def kept() -> dict[str, Callable[..., Any]]:
    """Exercise -> the learner's function that is kept for it, in the order of the course."""
    return {name: KEPT[name] for name in _exercises() if name in KEPT}


def clear_counts() -> None:
    """Set the numbers of calls and the times of the board to zero."""
    CALLS.clear()


@dataclass(frozen=True, kw_only=True)
class BoardRow:
    """One operation, or one piece of an operation, on the board."""

    operation: str
    """Name of the function of the library."""
    exercise: str
    """The exercise whose function replaces it, or "" if there is none."""
    code: Literal["yours", "solution", "reference"]
    """What is kept for it."""
    calls: Calls
    """Calls since the counts were last cleared."""

    @property
    def whose(self) -> str:
        """In words: yours, reference, solution, or both where yours leaves some calls to the reference."""
        if self.code == "yours" and self.calls.reference:
            return f"yours, {self.calls.reference} calls by the reference"
        return self.code


class Board:
    """Which operations run the learner's code, how often they were called, and for how long. Made by ``board``."""

    def __init__(self, rows: list[BoardRow]):
        self.rows = rows

    @property
    def yours(self) -> list[str]:
        """Operations for which a function of the learner is kept."""
        return [row.operation for row in self.rows if row.code == "yours"]

    @property
    def line(self) -> str:
        """A summary in one line."""
        exercise_rows = [row for row in self.rows if row.exercise]
        return f"{len(self.yours)} of {len(exercise_rows)} operations that have an exercise run your code"

    def __repr__(self) -> str:
        head = f"{'operation':26} {'whose':10} {'calls':>8} {'ms':>9} {'ms/call':>8}  exercise"
        rows = [
            f"{row.operation:26} {'YOURS' if row.code == 'yours' else row.whose:10} {n:8,} {1e3 * s:9.1f} {each:>8}  "
            f"{row.exercise}"
            for row, n, s, each in self._numbers()
        ]
        return "\n".join([head, *rows, self.line])

    def _repr_html_(self) -> str:
        colours = {"yours": "#1a7f37", "solution": "#0969da", "reference": "#6e7781"}
        mark = Markup('<span style="color:{}">●</span> <b>{}</b>')
        rows = [
            (mark.format(colours[row.code], row.operation), row.whose, f"{n:,}", f"{1e3 * s:.1f}", each, row.exercise)
            for row, n, s, each in self._numbers()
        ]
        heads = ("operation", "whose code", "calls", "ms", "ms per call", "exercise")
        return html_table(rows, heads=heads, foot=self.line, style="font-size:12px", cell_style="text-align:left")

    def _numbers(self) -> list[tuple[BoardRow, int, float, str]]:
        """Each row with its number of calls, its seconds, and the milliseconds of one call."""
        numbers = []
        for row in self.rows:
            n, s = row.calls.own + row.calls.reference, row.calls.seconds
            numbers.append((row, n, s, f"{1e3 * s / n:.3g}" if n else "-"))
        return numbers


def board(chapters: Collection[int] | None = None) -> Board:
    """Every operation that has an exercise or has run: whose code, how often, how long. Yours come first.

    The time of an operation does not contain that of other operations that it calls, so the times add up.

    Args:
        chapters: Of operations that have not run, only those with an exercise in these chapters. Default: all.
    """
    known = _exercises()
    of_operation = {e.becomes.operation: e for e in known.values() if e.becomes is not None}
    shown = [name for name, e in of_operation.items() if name in CALLS or chapters is None or e.chapter in chapters]

    def row(name: str) -> BoardRow:
        exercise = of_operation[name].name if name in of_operation else ""
        is_solution = exercise in KEPT and KEPT[exercise] is known[exercise]._solution
        code = "solution" if is_solution else "yours" if name in FUNCTIONS else "reference"
        return BoardRow(operation=name, exercise=exercise, code=code, calls=CALLS.get(name, Calls()))

    rows = [row(name) for name in [*shown, *(name for name in CALLS if name not in of_operation)]]
    return Board(sorted(rows, key=lambda row: ("yours", "solution", "reference").index(row.code)))


def _exercises() -> dict[str, Any]:
    from .exercise import exercises  # which imports this module

    return exercises()
