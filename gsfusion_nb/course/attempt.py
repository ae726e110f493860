"""A student's function under test, and the statements a checker makes about what it returns."""

import contextlib
import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..types import Camera
from .guard import Broken, Guard, settled
from .place import place_of

_seen: ContextVar[list[str] | None] = ContextVar("_seen", default=None)


@contextlib.contextmanager
def watching_properties() -> Iterator[list[str]]:
    """Inside the block the list gets every property that a judge asks for, in order."""
    seen: list[str] = []
    token = _seen.set(seen)
    try:
        yield seen
    finally:
        _seen.reset(token)


def _note(prop: str) -> None:
    seen = _seen.get()
    if seen is not None:
        seen.append(prop)


class Failed(Exception):
    """A property does not hold: ``prop`` names it, ``on`` the input, ``detail`` what was returned and expected."""

    def __init__(self, prop: str, on: str, detail: str):
        super().__init__(f"{prop} (on {on}): {detail}")
        self.prop, self.on, self.detail = prop, on, detail


class NotCallable(Failed):
    """There is no function that an input could be given to: ``on`` stays empty."""


class NotWritten(Exception):
    """The function returned nothing: its body is still ``...``."""


class Attempt:
    """Calls the student's function on copies of its arguments; if it raises or changes them, that is a ``Failed``.

    ``on`` describes the input of a call in words: those given by ``attempt.on("...")`` before it, or made from it.
    NumPy arrays come back as tensors, NumPy numbers as Python's, and what a generator yields as a list.
    """

    def __init__(self, function: Callable[..., Any], guard: Guard | None = None):
        self.function, self.guard = function, guard
        self.words = ""
        self.returned: Any = None
        """What the last call returned."""

    def on(self, words: str) -> "Attempt":
        """Describe the input of the next calls: ``attempt.on("a pixel at 2 m")(camera, uv, depth)``."""
        self.words = words
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        given, named = [_copied(a) for a in args], {k: _copied(a) for k, a in kwargs.items()}
        on = self.words or describe([*args, *kwargs.values()])
        self.returned = self._run(self.function, given, named, on)
        for before, after in zip([*args, *kwargs.values()], [*given, *named.values()], strict=True):
            if not _same(before, after):
                names = {Tensor: "a tensor", np.ndarray: "an array", Camera: "the camera"}
                what = names.get(type(before), f"a {type(before).__name__}")
                detail = f"{what} that was passed in has changed; work on a copy"
                raise Failed("it does not change its inputs", on, detail)
        return self.returned

    def each(self, calls: Sequence[tuple]) -> list[Any]:
        """The results for many tuples of arguments, in one go."""
        function = self.function

        @functools.wraps(function)
        def in_turn() -> list[Any]:
            return [function(*args) for args in calls]

        results = self._run(in_turn, (), {}, self.words)
        self.returned = results[-1]
        if any(result is None or result is Ellipsis for result in results):
            raise NotWritten
        return results

    def _run(self, function: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any], on: str) -> Any:
        try:
            result = self._guarded(function, args, kwargs)
        except NotImplementedError:
            raise NotWritten from None
        except NotCallable:
            raise
        except (Broken, Failed) as e:  # Failed: it runs in another process, which says what happened
            raise Failed(e.prop, on, e.detail) from None
        except Exception as e:
            place = place_of(e, self.function)
            raised = f"it raised {type(e).__name__}{f' in {place}' if place else ''}"
            raise Failed("it runs", on, f"{raised}: {str(e).splitlines()[0] if str(e) else ''}") from e
        if result is None or result is Ellipsis:
            raise NotWritten
        return result

    def _guarded(self, function: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        if self.guard is None:
            return settled(function(*args, **kwargs))
        return self.guard.run(function, args, kwargs)

    @property
    def watched(self) -> Callable[..., Any]:
        """The function with its signature, for a check that calls it itself."""

        @functools.wraps(self.function)
        def call(*args: Any, **kwargs: Any) -> Any:
            return self._guarded(self.function, args, kwargs)

        return call


def _copied(value: Any) -> Any:
    """A copy of an argument, for those kinds that a learner's function could change."""
    if isinstance(value, Tensor):
        return value.clone()
    return copy.deepcopy(value) if isinstance(value, (np.ndarray, list, dict, Camera)) else value


def _same(before: Any, after: Any) -> bool:
    """Whether an argument is as it was."""
    if isinstance(before, Tensor):
        return before.shape == after.shape and torch.equal(before.nan_to_num(), after.nan_to_num())
    if isinstance(before, np.ndarray):
        return np.array_equal(before, after, equal_nan=True)
    return before == after if isinstance(before, (list, dict, Camera)) else True


def plain(value: Any) -> Any:
    """``value`` with NumPy arrays as tensors, NumPy numbers as Python's, and generators as lists."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Iterator):
        return [plain(v) for v in value]
    if type(value) in (tuple, list):
        parts = [plain(v) for v in value]
        return tuple(parts) if type(value) is tuple else parts
    return value


def holds(condition: Any, prop: str, *, on: str, detail: str) -> None:
    """``prop`` fails, with ``detail``, unless ``condition`` is true."""
    _note(prop)
    if not bool(condition):
        raise Failed(prop, on, detail)


def close(
    got: Any, expected: Any, prop: str, *, on: str, tolerance: float = 1e-5, why: str = "", names: Sequence[str] = ()
) -> None:
    """``prop`` fails unless ``got`` has the shape and, within ``tolerance`` x max(1, size), the values of ``expected``.

    Args:
        got: What the student returned: a number, a sequence, an array or a tensor.
        expected: The right answer.
        prop: A statement that is true of a right answer: "the depth is the point's z".
        on: The input, in words.
        tolerance: Largest deviation.
        why: What a deviation usually means; ends the message.
        names: Of the values, where ``got`` is a list that the judge made from parts of an answer.
    """
    _note(prop)
    right, mine = as_tensor(expected), _numbers(got, prop, on)
    if mine.shape != right.shape:
        raise Failed(prop, on, f"the shape is {list(mine.shape)}, expected {list(right.shape)}")
    if not torch.isfinite(mine).eq(torch.isfinite(right)).all():
        raise Failed(prop, on, "a value is NaN or infinite")
    off = (mine - right).nan_to_num().abs() - tolerance * right.nan_to_num().abs().clamp(min=1.0)
    if off.numel() and float(off.max()) > 0:
        at = int(off.argmax())
        place = f" for {names[at]}" if names else f" at {_position(at, right.shape)}" if right.ndim else ""
        detail = f"got {_short(mine.reshape(-1)[at])}{place}, expected {_short(right.reshape(-1)[at])}"
        raise Failed(prop, on, f"{detail}{': ' if why[0].islower() else '. '}{why}" if why else detail)


def unpack(value: Any, names: Sequence[str], *, on: str) -> tuple[Any, ...]:
    """The parts of a returned tuple, one for each name; fails unless there are exactly that many."""
    if not isinstance(value, (tuple, list)) or len(value) != len(names):
        raise Failed(f"it returns {', '.join(names)}", on, f"it returned {describe([value])}")
    return tuple(value)


def as_rows(value: Any) -> Any:
    """A tensor of two dimensions as a list of lists; everything else as it is."""
    return value.tolist() if isinstance(value, Tensor) and value.ndim == 2 else value


def as_tensor(value: Any) -> Tensor:
    """``value`` as float64 on the CPU; a list of tensors becomes one."""
    if isinstance(value, (list, tuple)) and value and all(isinstance(v, Tensor) and v.ndim for v in value):
        return torch.stack([as_tensor(v) for v in value])
    return torch.as_tensor(value).detach().cpu().to(torch.float64)


def describe(values: Sequence[Any]) -> str:
    """Arguments in a few words: small ones by value, tensors by shape, others by type."""
    return ", ".join(_words(v) for v in values) or "no arguments"


def _words(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.tolist()}" if value.numel() <= 4 else f"a tensor {list(value.shape)}"
    if isinstance(value, (bool, int, float, str)):
        return repr(value)
    if isinstance(value, (tuple, list)):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


def _numbers(value: Any, prop: str, on: str) -> Tensor:
    try:
        return as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        raise Failed(prop, on, f"it returned {describe([value])}, which is not an array of numbers") from None


def _position(flat: int, shape: torch.Size) -> str:
    index = []
    for size in reversed(shape):
        index.append(flat % size)
        flat //= size
    return str(list(reversed(index)))


def _short(value: Tensor) -> str:
    number = float(value) + 0.0  # no -0
    return f"{number:.0f}" if number.is_integer() and abs(number) < 1e12 else f"{number:.5g}"
