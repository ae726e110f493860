"""A learner's function under test, and the statements that a judge makes about what it returns."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from ..errors import ForeseenError
from ..types import Camera
from .in_words import in_words, line_in_words, line_of_error
from .learner_code import Failed as Failed
from .learner_code import argument_copy, calls_of_library, full_name, run_learner


class NotWritten(ForeseenError):
    """The function returned nothing: its body is still ``...``."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What one call of a learner's function gave."""

    value: Any
    """Tensors and plain values."""
    callees: Mapping[str, str]
    """Functions of the library that it called (``full_name``) -> the line, in words."""
    borrowed: Mapping[int, str]
    """Lines at which a function of the library returned the answer: number -> in words."""


@runtime_checkable
class Subject(Protocol):
    """A learner's function, in this process or in another one."""

    @property
    def function(self) -> Callable[..., Any]:
        """It, or what stands for it here, with its signature."""
        ...

    def answer(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Answer:
        """Call it. Tensors, arrays, lists and generators that it changes are changed afterwards.

        Raises:
            Failed: it raised, did not end, or returned something that is no plain value.
            NotWritten: it says that it is not implemented.
        """
        ...


@dataclass(frozen=True)
class LocalSubject:
    """A learner's function in this process."""

    function: Callable[..., Any]

    def answer(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Answer:
        """Call it, with a limit of time."""
        try:
            with calls_of_library(self.function) as calls:
                result = run_learner(self.function, args, kwargs)
        except NotImplementedError:
            raise NotWritten from None
        except Failed:  # it broke a rule that holds for every exercise
            raise
        except Exception as e:
            place = line_of_error(e, self.function)
            failure = f"it raised {type(e).__name__}{f' in {place}' if place else ''}"
            first_line = str(e).splitlines()[0] if str(e) else ""
            raise Failed("it runs", "", f"{failure}: {first_line}") from e
        code = getattr(inspect.unwrap(self.function), "__code__", None)
        file = "" if code is None else code.co_filename
        return Answer(
            value=result,
            callees={name: line_in_words(file, line) for line, name, _ in calls},
            borrowed={
                line: line_in_words(file, line)
                for line, _, value in calls
                if _is_answer(value, result)
            },
        )


class Attempt:
    """Calls the student's function on copies of its arguments; if it raises or changes them, that
    is a ``Failed``.

    ``on`` describes the input of a call in words: those given by ``attempt.on("...")`` before it,
    or made from it. NumPy arrays come back as tensors, NumPy numbers as Python's, and what a
    generator yields as a list.
    """

    def __init__(self, subject: Subject):
        self.subject = subject
        self.words = ""
        self.returned: Any = None
        """What the last call returned."""
        self.callees: dict[str, str] = {}
        """Functions of the library that it called, and where."""
        self.borrowed: dict[int, str] | None = None
        """Lines at which a function of the library returned the answer, in every call so far."""

    def on(self, words: str) -> "Attempt":
        """Describe the input of the next calls:
        ``attempt.on("a pixel at 2 m")(camera, uv, depth)``."""
        self.words = words
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        arguments = [argument_copy(a) for a in args]
        keywords = {k: argument_copy(a) for k, a in kwargs.items()}
        case = self.words or describe([*args, *kwargs.values()])
        try:
            answer = self.subject.answer(arguments, keywords)
        except Failed as e:
            raise Failed(e.prop, case, e.detail) from e.__cause__
        if answer.value is None or answer.value is Ellipsis:
            raise NotWritten
        self.callees |= answer.callees
        self.borrowed = {
            line: words
            for line, words in answer.borrowed.items()
            if self.borrowed is None or line in self.borrowed
        }
        self.returned = answer.value
        for old, new in zip(
            [*args, *kwargs.values()],
            [*arguments, *keywords.values()],
            strict=True,
        ):
            if not _same(old, new):
                names = {Tensor: "a tensor", np.ndarray: "an array", Camera: "the camera"}
                what = names.get(type(old), f"a {type(old).__name__}")
                detail = f"{what} that was passed in has changed; work on a copy"
                raise Failed("it does not change its inputs", case, detail)
        return self.returned

    def not_borrowed(self, functions: Sequence[Callable[..., Any]]) -> None:
        """Fails if functions of the library returned the answer in every call, or it called one
        that it replaces."""
        names = [full_name(function) for function in functions]
        lines = [self.callees[name] for name in names if name in self.callees]
        for line in [*lines, *(self.borrowed or {}).values()]:
            raise Failed(
                "it computes the answer itself",
                self.words,
                f"a function of the library gave the answer in {line}. Write what that function "
                "computes",
            )

    def holds(self, condition: Any, prop: str, *, detail: str) -> None:
        """``prop`` fails, with ``detail``, unless ``condition`` is true."""
        if not bool(condition):
            raise Failed(prop, self.words, detail)

    def close(
        self,
        got: Any,
        reference: Any,
        prop: str,
        *,
        tolerance: float = 1e-5,
        why: str = "",
        names: Sequence[str] = (),
    ) -> None:
        """``prop`` fails unless ``got`` has the shape and the values of ``reference``.

        Args:
            got: What the student returned: a number, a sequence, an array or a tensor.
            reference: The right answer.
            prop: A statement that is true of a right answer: "the depth is the point's z".
            tolerance: Largest deviation, in units of max(1, size of the value).
            why: What a deviation usually means; ends the message.
            names: Of the values, where ``got`` is a list that the judge made from parts of an
                answer.
        """
        case = self.words
        right = as_tensor(reference)
        mine = self._of_shape(got, right, prop)
        if not torch.isfinite(mine).eq(torch.isfinite(right)).all():
            raise Failed(prop, case, "a value is NaN or infinite")
        excess = (mine - right).nan_to_num().abs() - tolerance * right.nan_to_num().abs().clamp(
            min=1.0
        )
        if excess.numel() and float(excess.max()) > 0:
            at = int(excess.argmax())
            place = f" for {names[at]}" if names else _place(at, right)
            detail = (
                f"got {_short(mine.reshape(-1)[at])}{place}, expected "
                f"{_short(right.reshape(-1)[at])}"
            )
            raise Failed(
                prop, case, f"{detail}{': ' if why[0].islower() else '. '}{why}" if why else detail
            )

    def signs(self, got: Any, reference: Any, prop: str, *, why: str = "") -> None:
        """``prop`` fails unless ``got`` has the shape of ``reference`` and the signs of its values.

        What is said is the value that was returned, and not its sign.
        """
        right = as_tensor(reference)
        mine = self._of_shape(got, right, prop)
        others = (mine.sign() != right.sign()).flatten()  # so is NaN
        at = int(others.int().argmax()) if others.any() else 0
        expected = {1.0: "a positive number", -1.0: "a negative number", 0.0: "0"}
        words = expected[float(right.sign().flatten()[at])]
        detail = f"got {_short(mine.flatten()[at])}{_place(at, right)}, expected {words}"
        self.holds(not others.any(), prop, detail=f"{detail}: {why}" if why else detail)

    def _of_shape(self, got: Any, right: Tensor, prop: str) -> Tensor:
        """``got`` as numbers; ``prop`` fails unless they have the shape of ``right``."""
        mine = _numbers(got, prop, self.words)
        if mine.shape != right.shape:
            detail = f"the shape is {list(mine.shape)}, expected {list(right.shape)}"
            raise Failed(prop, self.words, detail)
        return mine

    def rigid(self, R: Any, prop: str, *, why: str = "") -> None:
        """``prop`` fails unless ``R`` [3, 3] is a rotation or a reflection."""
        rows = _numbers(R, prop, self.words)
        off = (rows @ rows.T - torch.eye(3, dtype=rows.dtype)).abs()
        lengths = ", ".join(_short(length) for length in rows.norm(dim=1))
        detail = (
            f"the rows of its rotation have the lengths {lengths}; expected 1, 1, 1, and right "
            "angles between them"
        )
        self.holds(off.max() <= 1e-6, prop, detail=f"{detail}: {why}" if why else detail)

    def unpack(self, value: Any, names: Sequence[str]) -> tuple[Any, ...]:
        """The parts of a returned tuple, one for each name; fails unless there are exactly that
        many."""
        if not isinstance(value, (tuple, list)) or len(value) != len(names):
            raise Failed(
                f"it returns {', '.join(names)}", self.words, f"it returned {describe([value])}"
            )
        return tuple(value)

    @property
    def watched(self) -> Callable[..., Any]:
        """The function with its signature, for a check that calls it itself."""

        function = self.subject.function

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            return run_learner(function, args, kwargs)

        return call


def _same(old: Any, new: Any) -> bool:
    """Whether an argument is as it was."""
    if isinstance(old, Tensor):
        return old.shape == new.shape and torch.equal(old.nan_to_num(), new.nan_to_num())
    if isinstance(old, np.ndarray):
        return np.array_equal(old, new, equal_nan=True)
    return old == new if isinstance(old, (list, dict, Camera)) else True


def _is_answer(value: Any, answer: Any) -> bool:
    """Whether what a function of the library returned has the values of the learner's answer."""
    if isinstance(value, (list, tuple)) and isinstance(answer, (list, tuple)):
        return len(value) == len(answer) and all(map(_is_answer, value, answer))
    try:
        return torch.equal(*(as_tensor(x).flatten().nan_to_num() for x in (value, answer)))
    except (TypeError, ValueError, RuntimeError, IndexError):
        return False


def as_rows(value: Any) -> Any:
    """A tensor of two dimensions as a list of lists; everything else as it is."""
    return value.tolist() if isinstance(value, Tensor) and value.ndim == 2 else value


def as_tensor(value: Any) -> Tensor:
    """``value`` as float64 on the CPU; a list of tensors becomes one."""
    if (
        isinstance(value, (list, tuple))
        and value
        and all(isinstance(v, Tensor) and v.ndim for v in value)
    ):
        return torch.stack([as_tensor(v) for v in value])
    return torch.as_tensor(value).detach().cpu().to(torch.float64)


def describe(values: Sequence[Any]) -> str:
    """Arguments in a few words."""
    return ", ".join(map(in_words, values)) or "no arguments"


def _numbers(value: Any, prop: str, case: str) -> Tensor:
    try:
        return as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        raise Failed(
            prop, case, f"it returned {describe([value])}, which is not an array of numbers"
        ) from None


def _place(at: int, values: Tensor) -> str:
    """Where element number ``at`` stands, in words; empty for a single number."""
    position = [int(i) for i in np.unravel_index(at, tuple(values.shape))]
    return f" at {position}" if position else ""


def _short(value: Tensor) -> str:
    number = float(value) + 0.0  # no -0
    return f"{number:.0f}" if number.is_integer() and abs(number) < 1e12 else f"{number:.5g}"
