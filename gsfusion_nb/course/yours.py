"""A learner's function inside the library: called on copies, results checked, errors named with cell and line."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import torch
from torch import Tensor

from ..backends import use_backend
from .attempt import plain
from .place import definition_of, place_of


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
    """A learner's function, as the adapter of its exercise calls it.

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
                self.fail(f"returned {len(bad)} NaN or infinite values for {name} [{_shape(value)}]{at}", args)

    def _called(self, args: Sequence[Any]) -> Any:
        try:
            with use_backend("reference"):
                return plain(self.function(*args))
        except Exception as e:
            reason = f"{type(e).__name__}: {str(e).splitlines()[0]}" if str(e) else type(e).__name__
            self.fail(f"raised {reason}", tuple(args), cause=e)

    def _checked(self, result: Any, gives: Mapping[str, Tensor] | None, args: tuple) -> Any:
        if gives is None:
            return result
        values = result if len(gives) > 1 else (result,)
        if not isinstance(values, (tuple, list)) or len(values) != len(gives):
            self.fail(f"must return {len(gives)} results ({', '.join(gives)}); it returned {_seen(result)}", args)
        checked = tuple(
            self._as_tensor(name, value, like, args) for (name, like), value in zip(gives.items(), values, strict=True)
        )
        return checked if len(gives) > 1 else checked[0]

    def fail(self, what: str, args: tuple = (), *, cause: Exception | None = None) -> NoReturn:
        """Raise ``LearnerError``: the function, its place, ``what`` it did, and the arguments that went in."""
        where = (cause is not None and place_of(cause, self.function)) or definition_of(self.function)
        message = f"your {self.exercise} ({where}) {what}. It ran as the operation {self.operation}"
        if args:
            names = _parameters(self.function, len(args))
            message += ", with " + "; ".join(f"{n} = {_seen(v)}" for n, v in zip(names, args, strict=True))
        raise LearnerError(message, self.exercise, where) from cause

    def _as_tensor(self, name: str, value: Any, like: Tensor, args: tuple) -> Tensor:
        """``value`` with the shape and type of ``like``; numbers, lists and NumPy arrays are converted."""
        if isinstance(value, Tensor) and value.shape == like.shape and value.dtype == like.dtype:
            return value.detach()
        expected = f"expected [{_shape(like)}] {_kind(like)}"
        try:
            got = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            self.fail(f"returned {_seen(value)} for {name}, which is not an array of numbers; {expected}", args)
        if got.shape != like.shape:
            self.fail(f"returned {_seen(value)} for {name}; {expected}", args)
        exact = isinstance(value, Tensor) or type(value).__module__ == "numpy"
        if like.is_floating_point() and (got.is_complex() or (exact and not got.is_floating_point())):
            self.fail(f"returned {_seen(value)} for {name}; {expected}", args)
        return got.detach().to(like)


def _parameters(function: Callable[..., Any], count: int) -> list[str]:
    try:
        names = list(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        names = []
    return [names[i] if i < len(names) else f"argument {i + 1}" for i in range(count)]


def _shape(tensor: Tensor) -> str:
    return ", ".join(map(str, tensor.shape))


def _kind(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")


@functools.singledispatch
def _seen(value: Any) -> str:
    """A value in a few words: a small one in full, an array by shape, type and range."""
    if isinstance(value, (bool, int, float, str)) or value is None:
        return repr(value)
    if type(value).__module__ == "numpy" and hasattr(value, "shape"):
        return f"an array {list(value.shape)} {getattr(value, 'dtype', '')}"
    if isinstance(value, (list, tuple)):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


@_seen.register
def _(value: Tensor) -> str:
    if value.numel() <= 4 and value.ndim <= 1:
        return str(value.tolist())
    words = f"[{_shape(value)}] {_kind(value)}"
    finite = value[value.isfinite()].double() if value.numel() else value
    if finite.numel():
        words += f", {float(finite.min()):.4g} to {float(finite.max()):.4g}"
    missing = value.numel() - finite.numel()
    return words + (f", {missing} not finite" if missing else "")
