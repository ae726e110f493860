"""The solution of an exercise, shown on request after an honest try."""

import inspect
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup


@dataclass(frozen=True)
class Solution:
    """Source code of a solution, as a notebook shows it."""

    exercise: str
    source: str

    def __repr__(self) -> str:
        return self.source

    def _repr_html_(self) -> str:
        block = "<details class='gsnb-solution' open><summary>A solution of {}</summary><pre>{}</pre></details>"
        return Markup(block).format(self.exercise, self.source)


@dataclass(frozen=True)
class NotYet:
    """The sentence that stands in for a solution before the first try."""

    exercise: str
    hints_left: int

    def __repr__(self) -> str:
        more = f" Before that: check.{self.exercise}.hint()" if self.hints_left else ""
        return (
            f"The solution of {self.exercise} opens after your first try: write the function and run "
            f"check.{self.exercise}({self.exercise}).{more}"
        )


def source_of(exercise: str, function: Callable[..., Any]) -> str:
    """Source of a solution under the exercise's name, after the private functions of its module that it calls."""
    sources = [inspect.getsource(each) for each in [*_called_by(function, {function}), function]]
    renamed = re.sub(rf"\b{re.escape(function.__name__)}\b", exercise, sources[-1])
    return "\n\n".join([*sources[:-1], renamed]).strip()


def without_source(function: Callable[..., Any]) -> Callable[..., Any]:
    """A copy of ``function`` that compilers can read and ``inspect.getsource`` cannot."""
    function = inspect.unwrap(function)
    code = function.__code__.replace(co_filename="<the reference's>")
    return types.FunctionType(code, function.__globals__, function.__name__, function.__defaults__)


def _called_by(function: Callable[..., Any], seen: set[Any]) -> Iterator[Callable[..., Any]]:
    plain = inspect.unwrap(function)
    code = getattr(plain, "__code__", None)
    names = code.co_names if code is not None else ()
    for name in names:
        other = getattr(plain, "__globals__", {}).get(name)
        if not isinstance(other, types.FunctionType) or other in seen:
            continue
        if name.startswith("_") and other.__module__ == function.__module__:
            seen.add(other)
            yield from _called_by(other, seen)
            yield other
