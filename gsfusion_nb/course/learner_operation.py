"""A learner's function in the place of an operation of the library: called on copies, results
checked, errors named."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from torch import Tensor

from ..backends import FUNCTIONS, use_backend
from ..errors import ForeseenError
from .in_words import in_words, kind_of, line_of_definition, line_of_error
from .learner_code import Failed, plain_value

KEPT: dict[str, Callable[..., Any]] = {}
"""Exercise -> the learner's newest accepted function."""


@dataclass(frozen=True)
class Becomes:
    """What a function becomes under the backend ``mine``: an operation of the library, or a piece
    of one."""

    operation: str
    """Name of the function with ``@op`` or ``@piece``."""
    adapter: Callable[..., Any]
    """Takes the learner's function (``Yours``) and the arguments of the operation; returns what the
    operation returns, or ``NotImplemented`` to leave this call to the reference."""


class LearnerError(ForeseenError, RuntimeError):
    """A learner's function failed inside the library; the message names its cell and line and what
    went in."""


class Yours:
    """A learner's function inside the library, as the adapter of its exercise calls it.

    While it runs, the backend is the reference, so that a library function that it calls does not
    call it again.

    Args:
        exercise: Name of the exercise.
        operation: The operation of the library that the function replaces.
        function: The learner's function.
    """

    def __init__(self, exercise: str, operation: str, function: Callable[..., Any]):
        self.exercise = exercise
        self.operation = operation
        self.function = function

    def __call__(
        self,
        *args: Any,
        gives: Mapping[str, Tensor] | None = None,
    ) -> Any:
        """Call the function on copies of the tensors in ``args``.

        Args:
            gives: Name of each result -> a tensor of the shape and type that it must have. One
                result is returned as a tensor, several as a tuple. Without ``gives`` the result is
                returned as it is.

        Raises:
            LearnerError: the function raised, or a result has another shape or type, or is not
                finite.
        """
        copies = [value.clone() if isinstance(value, Tensor) else value for value in args]
        result = self._call_function(copies)
        return result if gives is None else self._check_result(result, gives, args)

    def many(
        self,
        calls: Sequence[tuple],
        gives: Sequence[Mapping[str, Tensor]],
    ) -> list[Any]:
        """Call the function for each tuple of arguments. Raises as for one call."""
        return [self(*args, gives=like) for args, like in zip(calls, gives, strict=True)]

    def _call_function(self, args: Sequence[Any]) -> Any:
        try:
            with use_backend("reference"):
                return plain_value(self.function(*args))
        except Failed as e:
            self.fail(e.detail, tuple(args), cause=e)
        except Exception as e:
            reason = f"{type(e).__name__}: {str(e).splitlines()[0]}" if str(e) else type(e).__name__
            self.fail(f"raised {reason}", tuple(args), cause=e)

    def _check_result(
        self,
        result: Any,
        gives: Mapping[str, Tensor],
        args: tuple,
    ) -> Any:
        values = result if len(gives) > 1 else (result,)
        if not isinstance(values, (tuple, list)) or len(values) != len(gives):
            self.fail(
                f"must return {len(gives)} results ({', '.join(gives)}); it returned "
                f"{in_words(result)}",
                args,
            )
        outputs = tuple(
            self._as_tensor(name, value, like, args)
            for (name, like), value in zip(gives.items(), values, strict=True)
        )
        for name, value in zip(gives, outputs, strict=True):
            if not value.isfinite().all():
                bad = (~value.isfinite()).nonzero()
                at = f", the first at {bad[0].tolist()}" if value.ndim else ""
                self.fail(
                    f"returned {len(bad)} NaN or infinite values for {name} "
                    f"{list(value.shape)}{at}",
                    args,
                )
        return outputs if len(gives) > 1 else outputs[0]

    def _as_tensor(self, name: str, value: Any, like: Tensor, args: tuple) -> Tensor:
        """``value`` with the shape and type of ``like``; numbers and lists are converted."""
        if isinstance(value, Tensor) and value.shape == like.shape and value.dtype == like.dtype:
            return value
        kind = f"expected {kind_of(like)}"
        try:
            got = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            self.fail(
                f"returned {in_words(value)} for {name}, which is not an array of numbers; {kind}",
                args,
            )
        is_whole = isinstance(value, Tensor) and not got.is_floating_point()
        if got.shape != like.shape or (like.is_floating_point() and (is_whole or got.is_complex())):
            self.fail(f"returned {in_words(value)} for {name}; {kind}", args)
        return got.to(like)

    def fail(
        self,
        what: str,
        args: tuple = (),
        *,
        cause: Exception | None = None,
    ) -> NoReturn:
        """Raise ``LearnerError``: the function, its place, ``what`` it did, and the arguments that
        went in."""
        where = (cause is not None and line_of_error(cause, self.function)) or line_of_definition(
            self.function
        )
        message = f"your {self.exercise} ({where}) {what}. It ran as the operation {self.operation}"
        if args:
            names = list(inspect.signature(self.function).parameters)
            names += [f"argument {i + 1}" for i in range(len(names), len(args))]
            message += ", with " + "; ".join(
                f"{n} = {in_words(v)}" for n, v in zip(names, args, strict=False)
            )
        raise LearnerError(message) from cause


def remember(
    exercise: str,
    becomes: Becomes | None,
    function: Callable[..., Any],
) -> None:
    """Keep ``function`` for an exercise, in place of an earlier one."""
    KEPT[exercise] = function
    if becomes is not None:
        yours = Yours(exercise, becomes.operation, function)
        FUNCTIONS[becomes.operation] = functools.partial(becomes.adapter, yours)
