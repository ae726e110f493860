"""A learner's function outside the library: how it is run, and whose code a
chapter goes on with.

It runs with a limit of time, and its results become plain values. A chapter goes on with it if it
passes, else with the reference's.
"""

import contextlib
import copy
import functools
import inspect
import itertools
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .. import backends
from ..drawing.page import fill
from ..errors import ForeseenError
from ..types import Camera
from .in_words import line_of_error

LIMIT_S = 60.0
"""How long one call of a learner's function may take, seconds."""
_LONGEST = 10_000
"""Most values that are taken from a generator."""


class Failed(ForeseenError):
    """A property does not hold: ``prop`` names it, ``on`` the input, ``detail`` what was returned
    and expected."""

    def __init__(self, prop: str, case: str, detail: str):
        super().__init__(f"{prop} (on {case}): {detail}")
        self.prop = prop
        self.on = case
        self.detail = detail


def plain_value(value: Any) -> Any:
    """A copy of a result, made of tensors, numbers, texts, lists, tuples, sets and dicts.

    NumPy arrays become tensors, NumPy numbers and fractions Python's, and what a generator yields a
    list. Objects of the library stay.

    Raises:
        Failed: an object of another kind, or a generator without end.
    """
    if value is None or value is Ellipsis or isinstance(value, (bool, int, float, complex, str)):
        return value
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Fraction):
        return float(value)
    for kind in (list, tuple, set, frozenset):
        if isinstance(value, kind):
            return kind([plain_value(part) for part in value])
    if isinstance(value, dict):
        return {plain_value(key): plain_value(part) for key, part in value.items()}
    if isinstance(value, (Iterator, range)):
        parts = [plain_value(part) for part in itertools.islice(value, _LONGEST + 1)]
        if len(parts) > _LONGEST:
            raise Failed(
                "it comes to an end",
                "",
                f"it returned a generator of more than {_LONGEST:,} values",
            )
        return parts
    if type(value).__module__.startswith(f"{__name__.partition('.')[0]}."):
        return value
    kinds = "tensors, arrays, numbers, texts, lists, tuples"
    raise Failed(
        "it returns plain values", "", f"it returned a {type(value).__name__}; expected {kinds}"
    )


def argument_copy(value: Any) -> Any:
    """A copy of an argument, for those kinds that a learner's function could change."""
    if isinstance(value, Tensor):
        return value.detach().clone()
    return copy.deepcopy(value) if isinstance(value, (np.ndarray, list, dict, Camera)) else value


class _TimeIsUp(BaseException):
    """Raised inside a learner's function that takes too long; no ``except Exception`` of theirs
    catches it."""


@contextlib.contextmanager
def calls_of_library(
    function: Callable[..., Any],
) -> Iterator[list[tuple[int, str, Any]]]:
    """Calls of this package's functions in the learner's file: line, ``full_name``, result; while
    the context is open.

    None for a function of the package itself.
    """
    calls: list[tuple[int, str, Any]] = []
    code: Any = getattr(inspect.unwrap(function), "__code__", None)
    usual = sys.getprofile()

    def watch(frame: Any, event: str, value: Any) -> None:
        # such as len() and [] of a value of the library
        operator = frame.f_code.co_name.startswith("__")
        if (
            event == "return"
            and not operator
            and _is_of_library(frame.f_globals.get("__name__", ""))
        ):
            caller = frame.f_back
            while caller is not None and _passes_on(caller.f_globals.get("__name__", "")):
                caller = caller.f_back
            if caller is not None and caller.f_code.co_filename == code.co_filename:
                module = frame.f_globals.get("__name__", "")
                name = f"{module}.{frame.f_code.co_qualname}"
                calls.append((caller.f_lineno, name, value))

    if code is not None and not _is_of_library(str(function.__module__)):
        sys.setprofile(watch)
    try:
        yield calls
    finally:
        sys.setprofile(usual)


def full_name(function: Callable[..., Any]) -> str:
    """``gsfusion_nb.tsdf.octree.encode``: module and name of a function, without decorators."""
    plain = inspect.unwrap(function)
    return f"{plain.__module__}.{plain.__qualname__}"


def _is_of_library(module: str) -> bool:
    return module.partition(".")[0] == __name__.partition(".")[0]


def _passes_on(module: str) -> bool:
    """Whether frames of a module stand between a learner's call and the library's function."""
    return module.startswith((backends.__name__, "jaxtyping"))


def run_learner(
    function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]
) -> Any:
    """The result of ``function`` as a plain value. A loop without end is left where the system has
    timers.

    Raises:
        Failed: it took too long, or returned something that is no plain value.
        Exception: what the function raised.
    """
    if not hasattr(signal, "SIGALRM") or threading.current_thread() is not threading.main_thread():
        return plain_value(function(*args, **kwargs))

    def stop(_signal: int, _frame: Any) -> None:
        raise _TimeIsUp

    usual = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        return plain_value(function(*args, **kwargs))
    except _TimeIsUp:
        raise endless(LIMIT_S) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, usual)


def endless(limit_s: float) -> Failed:
    """What is said of a function that did not end within ``limit_s`` seconds."""
    detail = (
        f"it ran for more than {limit_s:g} s. Is there a loop whose condition never becomes false?"
    )
    return Failed("it comes to an end", "", detail)


@dataclass(frozen=True, kw_only=True)
class CodeInUse:
    """One sentence: whose code a chapter uses for an exercise, and why."""

    exercise: str
    state: Literal["yours", "not yet yours", "fails"]
    why: str = ""

    def __repr__(self) -> str:
        if self.state == "yours":
            return f"{self.exercise}: your code is used."
        return f"{self.exercise}: the reference's is used: {self.why}"

    def _repr_html_(self) -> str:
        colours = {"yours": "#1a7f37", "not yet yours": "#6e7781", "fails": "#c62828"}
        return fill("whose_code.html", whose=self, colour=colours[self.state])

    def tell(self) -> None:
        """Show the sentence in the running cell, or print it."""
        ipython = sys.modules.get("IPython")
        if ipython is None or ipython.get_ipython() is None:
            sys.stdout.write(f"{self}\n")
        else:
            ipython.display.display(self)


def with_reference(
    exercise: str, function: Callable[..., Any], reference: Callable[..., Any]
) -> Any:
    """``function``, until a call raises: then a sentence names the line, and ``reference`` answers
    from there on.

    ``function`` gets copies of tensors and arrays. An interrupt is not caught.
    """
    has_failed = False

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal has_failed
        if not has_failed:
            copies = map(argument_copy, args)
            keywords = {name: argument_copy(value) for name, value in kwargs.items()}
            try:
                return plain_value(function(*copies, **keywords))
            except Exception as e:
                has_failed = True
                place = line_of_error(e, function)
                why = f"yours raised {type(e).__name__}{f' in {place}' if place else ''}: {e}"
                CodeInUse(exercise=exercise, state="fails", why=why).tell()
        return reference(*args, **kwargs)

    return call
