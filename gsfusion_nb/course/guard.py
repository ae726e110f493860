"""A learner's function while it is judged: a time limit, functions that it may not call, plain values as results.

The function runs in a thread of its own, so that a loop without end can be left. A profile function of that thread sees
every call. This keeps an honest learner from fooling themselves. Marks are given in processes of their own, where no
solution can be imported.
"""

import contextvars
import ctypes
import inspect
import itertools
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from torch import Tensor

LIMIT_S = 10.0
"""How long one call of a learner's function may take, in seconds of the processor."""
_CROWDED = 6
"""How many times as long it may take where other programs use the processor."""
LIBRARY_LIMIT_S = 60.0
"""The same for a function that runs stages of the library. Its judge runs them first, so that they are compiled."""
LARGEST = 10_000_000
"""Most numbers that a function may return."""
_LONGEST = 100_000
"""Most elements of a list that a function may return."""
_PATIENCE_S = 1.0
"""How long a function that is told to stop may take to do so."""


class Refused(BaseException):
    """Ends a learner's function; no ``except Exception`` of theirs catches it."""


class Broken(Exception):
    """A rule that holds for every exercise is broken: ``prop`` names it, ``detail`` says what was done."""

    def __init__(self, prop: str, detail: str):
        super().__init__(detail)
        self.prop, self.detail = prop, detail


@dataclass
class Guard:
    """What holds for every call of one learner's function."""

    limit_s: float = LIMIT_S
    refused: dict[int, str] = field(default_factory=dict)
    """id of a code object -> what calling it means, in words."""
    refused_names: dict[str, str] = field(default_factory=dict)
    """Name of a function written in C -> what calling it means."""
    broken: str = ""
    """The first refused call."""

    def refuse(self, functions: Sequence[Callable[..., Any]], means: str) -> None:
        """From now on a call of one of ``functions`` is refused; ``means`` completes "it calls NAME, ..."."""
        for function in functions:
            code = getattr(inspect.unwrap(function), "__code__", None)
            name = getattr(function, "__name__", "")
            if code is not None:
                self.refused[id(code)] = f"it calls {name}, {means}"
            else:
                self.refused_names[name] = f"it calls {name}, {means}"

    def run(self, function: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """The result of ``function``, as plain values.

        Raises:
            Broken: a rule was broken: time, refused calls, settings of torch, kinds and amount of results.
            Exception: what the function raised.
        """
        outcome = _Outcome()

        def call() -> None:
            threading.setprofile(self._watch)
            sys.setprofile(self._watch)
            try:
                outcome.result = settled(function(*args, **kwargs))
            except BaseException as e:
                outcome.error = e
            finally:
                sys.setprofile(None)
                threading.setprofile(None)  # pyright: ignore[reportArgumentType]

        context, dtype = contextvars.copy_context(), torch.get_default_dtype()
        self._wait(threading.Thread(target=lambda: context.run(call), name="learner", daemon=True))
        changed = torch.get_default_dtype() != dtype
        torch.set_default_dtype(dtype)
        if self.broken:
            raise Broken("it is your own code", self.broken)
        if isinstance(outcome.error, SystemExit):
            raise Broken("it returns its result", "it ended the program: exit() or SystemExit; use return")
        if isinstance(outcome.error, Exception):
            raise outcome.error
        if outcome.error is not None:
            raise Broken("it runs", f"it raised {type(outcome.error).__name__}")
        if changed:
            raise Broken("it leaves everything else as it is", "it changed torch's default type of numbers")
        return outcome.result

    def _wait(self, thread: threading.Thread) -> None:
        """Run the thread; stop it after the limit, or when the learner interrupts the notebook."""
        began, used = time.monotonic(), time.process_time()
        thread.start()
        try:
            while thread.is_alive() and self._has_time(time.monotonic() - began, time.process_time() - used):
                thread.join(0.2)
        finally:
            in_time = not thread.is_alive()
            stopped = in_time or _stop(thread)
        if not in_time:
            rest = "Is there a loop whose condition never becomes false?"
            rest = rest if stopped else "It does not stop: restart the kernel"
            raise Broken("it comes to an end", f"it ran for more than {self.limit_s:g} s. {rest}")

    def _has_time(self, wall_s: float, processor_s: float) -> bool:
        """A busy machine makes a function slow, so the limit is one of processor time; one that sleeps ends later."""
        return wall_s < self.limit_s or (processor_s < self.limit_s and wall_s < _CROWDED * self.limit_s)

    def _watch(self, frame: types.FrameType, event: str, arg: Any) -> None:
        """The profile function: notes a refused call and ends the learner's function."""
        if event == "call":
            means = self.refused.get(id(frame.f_code))
        elif event == "c_call":
            means = self.refused_names.get(getattr(arg, "__name__", ""))
        else:
            return
        if means is not None:
            self.broken = self.broken or means
            raise Refused(means)


@dataclass
class _Outcome:
    result: Any = None
    error: BaseException | None = None


class _TimeIsUp(BaseException):
    """Raised inside a learner's function that takes too long."""


def _stop(thread: threading.Thread) -> bool:
    """Raise ``_TimeIsUp`` in a thread again and again, in case it is caught; whether the thread ended."""
    for _ in range(int(_PATIENCE_S / 0.05)):
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident or 0), ctypes.py_object(_TimeIsUp))
        thread.join(0.05)
        if not thread.is_alive():
            return True
    return False


def settled(value: Any) -> Any:
    """A copy of ``value`` made of plain tensors, numbers, texts, lists, tuples, sets and dicts, no subclasses of them.

    NumPy arrays become tensors, NumPy numbers and fractions Python's, and what a generator yields a list. Objects of
    the library stay.

    Raises:
        Broken: too many numbers, or an object of another kind, which could answer each question as it likes.
    """
    if value is None or value is Ellipsis or type(value) in (bool, int, float, complex, str):
        return value
    if isinstance(value, Tensor):
        with torch._C.DisableTorchFunctionSubclass():
            _not_too_many(Tensor.numel(value))
            return Tensor.detach(value.as_subclass(Tensor)).clone()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        _not_too_many(value.size)
        return torch.from_numpy(np.array(value, subok=False))
    return _settled_number(value) if isinstance(value, (np.generic, int, float, str, Fraction)) else _parts(value)


def _settled_number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return settled(value.item())
    if isinstance(value, Fraction):
        return value.numerator / value.denominator
    exactly = {int: int.__int__, float: float.__float__, str: str.__str__}
    return next(convert(value) for kind, convert in exactly.items() if isinstance(value, kind))


def _parts(value: Any) -> Any:
    collections: tuple[Any, ...] = (list, tuple, set, frozenset)
    for kind in collections:
        if isinstance(value, kind):
            _not_too_many(kind.__len__(value), _LONGEST)
            return kind(settled(part) for part in kind.__iter__(value))
    if isinstance(value, dict):
        return {settled(key): settled(part) for key, part in dict.items(value)}
    if isinstance(value, (Iterator, range)):
        found = [settled(part) for part in itertools.islice(value, _LONGEST + 1)]
        _not_too_many(len(found), _LONGEST)
        return found
    module = type(value).__module__
    if module.startswith(f"{__name__.partition('.')[0]}."):
        return value
    kinds = "tensors, arrays, numbers, texts, lists, tuples"
    raise Broken("it returns plain values", f"it returned a {type(value).__name__}; expected {kinds}")


def _not_too_many(count: int, most: int = LARGEST) -> None:
    if count > most:
        raise Broken("it returns as many numbers as it is asked for", f"it returned more than {most:,} numbers")
