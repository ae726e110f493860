"""Everything that a checker finds in a function, not only the first property that fails."""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from ...types import Camera
from ..attempt import Attempt, Failed, NotWritten, plain
from ..exercise import Exercise
from ..whose import judging

_PURE = (torch.Tensor, np.ndarray, Camera, int, float, list, dict)
"""Arguments that a second call finds as the first one did."""
_STATEMENTS = ("close", "holds")
"""With these a judge states a property. What fails in another way ends the judgement."""


@dataclass
class Judged:
    """What a judge found in one function."""

    broken: list[Failed] = field(default_factory=list)
    """Properties that failed, the first one first."""
    held: list[str] = field(default_factory=list)
    """Properties that were tested and never failed."""
    right_on: list[str] = field(default_factory=list)
    """Inputs, in words, for which it returns what the solution returns."""


def judge_thoroughly(exercise: Exercise, function: Callable[..., Any]) -> Judged:
    """Run the judge of an exercise on a function to its end, or to an error from which it cannot go on.

    Raises:
        ValueError: no property fails, so the function is no wrong answer.
    """
    found = Judged()
    attempt = _Compared(function, exercise._solution)
    with _collecting(inspect.unwrap(exercise.judge).__globals__, found), judging(exercise.name):
        try:
            exercise.judge(attempt)
        except Failed as e:
            found.broken.append(e)
        except NotWritten:
            raise ValueError(f"{exercise.name}: the function is not written") from None
        except Exception:
            if not found.broken:
                raise
    if not found.broken:
        raise ValueError(f"{exercise.name}: {function.__name__} passes, so it is no wrong answer")
    props = {e.prop for e in found.broken}
    found.held = [prop for prop in dict.fromkeys(found.held) if prop not in props]
    wrong_on = {e.on for e in found.broken}
    found.right_on = [on for on, right in attempt.right.items() if right and on not in wrong_on]
    return found


class _Compared(Attempt):
    """An attempt that also notes for which inputs the solution returns the same."""

    def __init__(self, function: Callable[..., Any], solution: Callable[..., Any]):
        super().__init__(function)
        self.solution = solution
        self.right: dict[str, bool] = {}
        """Input, in words -> whether all calls with it returned what the solution returns."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        on = self.words
        returned = super().__call__(*args, **kwargs)
        pure = all(isinstance(a, _PURE) for a in (*args, *kwargs.values()))
        same = pure and _same(returned, Attempt(self.solution)(*args, **kwargs))
        self.right[on] = same and self.right.get(on, True)
        return returned


def _same(got: Any, expected: Any) -> bool:
    """Whether two answers are equal, to a rounding."""
    got, expected = plain(got), plain(expected)
    if isinstance(expected, (list, tuple)):
        return (
            isinstance(got, (list, tuple))
            and len(got) == len(expected)
            and all(_same(a, b) for a, b in zip(got, expected, strict=True))
        )
    if isinstance(expected, torch.Tensor | int | float) and isinstance(got, torch.Tensor | int | float):
        a, b = (torch.as_tensor(value).detach().double() for value in (got, expected))
        return a.shape == b.shape and torch.allclose(a, b, rtol=1e-5, atol=1e-7, equal_nan=True)
    return type(got) is type(expected) and got == expected


@contextmanager
def _collecting(module: dict[str, Any], found: Judged) -> Iterator[None]:
    """Within the block, the statements of a chapter's judges note a failure and go on."""

    def noting(statement: Callable[..., None]) -> Callable[..., None]:
        def noted(*args: Any, **kwargs: Any) -> None:
            prop = kwargs.get("prop", args[{"close": 2, "holds": 1}[statement.__name__]])
            try:
                statement(*args, **kwargs)
            except Failed as e:
                found.broken.append(e)
            else:
                found.held.append(prop)

        return noted

    original = {name: module[name] for name in _STATEMENTS if name in module}
    module.update({name: noting(statement) for name, statement in original.items()})
    try:
        yield
    finally:
        module.update(original)
