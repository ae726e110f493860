"""Whose code a chapter goes on with: the learner's, or the reference's; the notebook is always told.

``check.<exercise>.working(f)`` returns one of the two functions below.
"""

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..drawing.page import fill
from .attempt import plain
from .place import place_of
from .verdict import Verdict

_COLOURS = {"yours": "#1a7f37", "not yet yours": "#6e7781", "fails": "#c62828"}

_judged: set[str] = set()
"""The exercise whose function is judged; in the whole process, because a function may start threads of its own."""


@dataclass(frozen=True, kw_only=True)
class WhoseCode:
    """One sentence: whose code is used for an exercise, and why."""

    exercise: str
    state: Literal["yours", "not yet yours", "fails"]
    why: str = ""

    def __repr__(self) -> str:
        if self.state == "yours":
            return f"{self.exercise}: your code is used."
        return f"{self.exercise}: the reference's is used: {self.why}"

    def _repr_html_(self) -> str:
        return fill("whose_code.html", whose=self, colour=_COLOURS[self.state])


def whose_code(verdict: Verdict) -> WhoseCode:
    """The sentence that follows from a verdict on the learner's function."""
    if verdict:
        return WhoseCode(exercise=verdict.exercise, state="yours")
    if verdict.state == "not written":
        return WhoseCode(exercise=verdict.exercise, state="not yet yours", why="not yet yours.")
    on = f" (on {verdict.on})" if verdict.on else ""
    why = f"yours fails “{verdict.prop}”{on}: {verdict.detail}"
    return WhoseCode(exercise=verdict.exercise, state="fails", why=why)


def tell(whose: WhoseCode) -> None:
    """Show the sentence in the running cell, or print it."""
    ipython = sys.modules.get("IPython")
    if ipython is None or ipython.get_ipython() is None:
        sys.stdout.write(f"{whose}\n")
    else:
        ipython.display.display(whose)


def yours_with_reference(exercise: str, function: Callable[..., Any], reference: Callable[..., Any]) -> Any:
    """``function``, until a call raises: then the sentence names the line, and ``reference`` answers from there on.

    Tensors and arrays that a failing call has changed are as before when ``reference`` gets them. An interrupt is not
    caught.
    """
    failed = False

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal failed
        if not failed:
            inputs = [value for value in (*args, *kwargs.values()) if isinstance(value, (Tensor, np.ndarray))]
            before = [_copy(value) for value in inputs]
            try:
                return plain(function(*args, **kwargs))
            except Exception as e:
                failed = True
                place = place_of(e, function)
                why = f"yours raised {type(e).__name__}{f' in {place}' if place else ''}: {e}"
                changed = [_restored(value, copy) for value, copy in zip(inputs, before, strict=True)]
                if any(changed):
                    why += " (it had changed its inputs before, which is taken back)"
                tell(WhoseCode(exercise=exercise, state="fails", why=why))
        return reference(*args, **kwargs)

    return call


def _copy(value: Tensor | np.ndarray) -> Tensor | np.ndarray:
    return value.detach().clone() if isinstance(value, Tensor) else value.copy()


def _restored(value: Any, before: Any) -> bool:
    """Give ``value`` its earlier content; whether it had changed."""
    if isinstance(value, Tensor):
        changed = value.shape != before.shape or not torch.equal(value.nan_to_num(), before.nan_to_num())
        if changed:
            value.data = before
        return changed
    changed = not np.array_equal(value, before, equal_nan=value.dtype.kind in "fc")
    if changed:
        value[...] = before
    return changed


def reference_only(exercise: str, reference: Callable[..., Any]) -> Any:
    """``reference``, which refuses to answer while its exercise is judged: it cannot be handed in."""

    def call(*args: Any, **kwargs: Any) -> Any:
        if exercise in _judged:
            raise RuntimeError(f"the reference's {exercise} is for the rest of the chapter; write your own")
        return reference(*args, **kwargs)

    call.__name__, call.__qualname__, call.__doc__ = exercise, exercise, reference.__doc__
    call.__signature__ = inspect.signature(reference)  # pyright: ignore[reportFunctionMemberAccess]
    return call


@contextlib.contextmanager
def judging(exercise: str) -> Iterator[None]:
    """Inside the block a learner's function is judged.

    Raises:
        RuntimeError: another one is judged at this moment, because this one calls a checker.
    """
    if _judged:
        raise RuntimeError("a function that is judged cannot ask a checker")
    _judged.add(exercise)
    try:
        yield
    finally:
        _judged.clear()
