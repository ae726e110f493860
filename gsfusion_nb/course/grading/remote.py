"""A submission's function in a sandbox, called like one of this process: values go there and back."""

import inspect
import math
import pickle
import re
import signal
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from ...mapping import GSFusion
from ...optim import Keyframe
from ..attempt import Failed, NotCallable, NotWritten
from ..exercise import exercises
from ..sandbox.messages import LARGEST_BYTES, ChannelClosed, CodecError, TooLarge, TooSlow, decode, receive, send
from ..sandbox.needed import Cell

WITHIN = "it stays within the limits of time and memory"
ENDED = "it returns an answer"
_WAITS = "does it sleep, or wait for something?"
_LOOPS = "is there a loop that does not end, or a much too slow one?"
_COURSE = "The course's own modules are not there when a submission is marked: write the function yourself"
_NO_COURSE = re.compile(r"No module named 'gsfusion_nb\.course\b")
_CRASHED = "its process ended without an answer: it crashed, left Python, or used too much memory"
_ENDS_S = 10.0
"""How long a function's process may take to end after its last call."""
LENT = {"quadtree_leaves": ("contrast", "split_cell")}
"""Exercise -> others whose reference may stand in for the student's that failed, as it does in the notebook."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one exercise of one submission."""

    seconds: float = 30.0
    """Processor time for its function, all calls together, so that a busy machine changes no mark."""
    memory_mb: int = 1024
    """Beyond what Python, torch and this package take."""

    @property
    def cpu_s(self) -> int:
        """``seconds`` as the system limits them."""
        return max(1, math.ceil(self.seconds))

    @property
    def wall_s(self) -> float:
        """How long an answer is waited for, which ends a function that sleeps."""
        return 30.0 + 4.0 * self.seconds


class Remote:
    """A submission's function in a sandbox at the other end of the socket ``to``."""

    def __init__(self, to: socket.socket, name: str, cells: Sequence[Cell], accepted: frozenset[str], limits: Limits):
        self.__name__ = self.__qualname__ = name
        self._to, self._cells, self._accepted, self._limits = to, cells, accepted, limits
        self._left_s = limits.wall_s
        self._begun = False
        self._lost: Failed | None = None
        self._signal: Any = None

    @property
    def __signature__(self) -> inspect.Signature:
        """That of the submission's function."""
        self._begin()
        if self._parameters is None:
            raise ValueError("the function has no signature")
        return _signature(self._parameters)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it with copies of the arguments; tensors and arrays that it changes are changed here, too."""
        self._begin()
        askable = {i: value for i, value in enumerate(args) if callable(value)}
        sent = [_sent(i, value) for i, value in enumerate(args)]
        self._say(("call", sent, kwargs))
        while True:
            kind, *rest = self._hear()
            if kind == "callback":
                number, inner, states = _parts(rest, 3)
                _apply_states(args, states)
                self._say(self._asked(askable.get(number), inner))
            elif kind == "reference":
                self._say(self._lent(*_parts(rest, 3)))
            elif kind == "returned":
                result, changed, states = _parts(rest, 3)
                _apply_changes(args, changed)
                _apply_states(args, states)
                return result
            elif kind == "not written":
                raise NotWritten
            else:
                self._fail(kind, rest)

    def _begin(self) -> None:
        if self._lost:
            raise self._lost
        if self._begun:
            return
        self._begun = True
        cells = [(cell.label, cell.source) for cell in self._cells]
        self._say({"cells": cells, "name": self.__name__, "accepted": sorted(self._accepted)})
        while True:
            kind, *rest = self._hear()
            if kind == "reference":
                self._say(self._lent(*_parts(rest, 3)))
            elif kind == "ready":
                (self._parameters,) = _parts(rest, 1)
                return
            else:
                self._fail_without_input(kind, rest)

    def _asked(self, function: Callable[..., Any] | None, inner: Any) -> tuple[str, Any]:
        """The answer to a call of a function that was an argument."""
        if function is None or not isinstance(inner, list):
            return "refused", "there is no such function"
        try:
            return "value", function(*map(_view, inner))
        except Exception as e:
            return "refused", f"{type(e).__name__}: {e}"

    def _lent(self, name: Any, args: Any, kwargs: Any) -> tuple[str, Any]:
        """The answer to a call of another exercise's reference."""
        if name not in LENT.get(self.__name__, ()) or not isinstance(args, tuple) or kwargs:
            return "refused", f"the reference's {name} is for the rest of the chapter; write your own"
        try:
            return "value", exercises()[name]._solution(*args)
        except Exception as e:
            return "refused", f"{type(e).__name__}: {e}"

    def end(self) -> bool:
        """No more calls; whether the function's process ended as it should."""
        if not self._begun or self._lost:
            return not self._lost
        self._left_s = _ENDS_S
        try:
            self._say(("done",))
            while True:
                self._hear()
        except Failed:
            return self._signal == 0

    def _say(self, message: Any) -> None:
        self._to.settimeout(max(self._left_s, 0.1))
        try:
            send(self._to, pickle.dumps(message))
        except (ChannelClosed, TooSlow):
            self._lose(ENDED, _CRASHED)

    def _hear(self) -> list[Any]:
        began = time.monotonic()
        try:
            message = decode(receive(self._to, until=began + self._left_s))
        except TooSlow:
            self._lose(WITHIN, f"it had not ended after {self._limits.wall_s:g} s, and was stopped: {_WAITS}")
        except TooLarge:
            self._lose(ENDED, f"it returned more than {LARGEST_BYTES >> 20} MB")
        except ChannelClosed:
            self._lose(ENDED, _CRASHED)
        except CodecError as e:
            self._lose(ENDED, f"the process sent {e}")
        finally:
            self._left_s -= time.monotonic() - began
        if not isinstance(message, tuple) or not message:
            self._lose(ENDED, "the process sent something else than an answer")
        if message[0] == "ended":
            self._signal = message[-1]
            if self._signal == signal.SIGXCPU:
                seconds = self._limits.cpu_s
                self._lose(WITHIN, f"it had not ended after {seconds} s of processor time, and was stopped: {_LOOPS}")
            self._lose(ENDED, _CRASHED)
        return list(message)

    def _lose(self, prop: str, detail: str) -> NoReturn:
        """There is no process any more that could be called, or none that can be believed."""
        self._lost = Failed(prop, "", detail)
        raise self._lost from None

    def _fail_without_input(self, kind: Any, rest: list[Any]) -> Any:
        try:
            self._fail(kind, rest)
        except Failed as e:
            raise NotCallable(e.prop, "", e.detail) from None

    def _fail(self, kind: Any, rest: list[Any]) -> Any:
        words = [_printable(word) for word in rest if isinstance(word, str)]
        out_of_memory = any(word is True for word in rest)
        if out_of_memory:
            raise Failed(WITHIN, "", f"it needed more than {self._limits.memory_mb} MB: is a tensor far too large?")
        if kind == "problem" and len(words) == 2:
            raise Failed(words[0], "", words[1])
        if kind == "raised" and words:
            raise Failed("it runs", "", f"{words[0]}. {_COURSE}" if _NO_COURSE.search(words[0]) else words[0])
        raise Failed(ENDED, "", "the process sent something else than an answer")


def _sent(number: int, value: Any) -> Any:
    """An argument as it is sent: a function as the right to ask for its value, a mapper as its state."""
    if isinstance(value, GSFusion):
        return ("mapper", value.config, value.state_dict() if value.volume.n_blocks else None)
    return ("ask", number) if callable(value) else value


def _view(value: Any) -> Any:
    """A view that was handed to a function of the grader: what is known of it is its kind and its index."""
    if isinstance(value, tuple) and value[:1] == ("view",) and len(value) == 3:
        index = int(value[2])
        if value[1] == "frame":
            return SimpleNamespace(index=index)
        blank = torch.zeros(1, 1, 3, dtype=torch.uint8)
        return Keyframe(index=index, rgb_u8=blank, camera=None, T_WC=torch.eye(4))  # pyright: ignore[reportArgumentType]
    return value


def _apply_changes(args: tuple[Any, ...], changed: Any) -> None:
    """Change the tensors and arrays in ``args`` as the submission changed its copies."""
    for i, value in _pairs(changed):
        target = args[i] if 0 <= i < len(args) else None
        if isinstance(target, Tensor) and isinstance(value, Tensor) and target.shape == value.shape:
            target.copy_(value)
        elif isinstance(target, np.ndarray) and isinstance(value, np.ndarray) and target.shape == value.shape:
            target[...] = value


def _apply_states(args: tuple[Any, ...], states: Any) -> None:
    """Put the mappers in ``args`` into the states that the submission left them in; settings and rule stay."""
    for i, state in _pairs(states):
        mapper = args[i] if 0 <= i < len(args) else None
        if not isinstance(mapper, GSFusion) or not isinstance(state, dict):
            continue
        kept = {key: mapper.state_dict()[key] for key in ("config", "rule")}
        try:
            vars(mapper).update(vars(GSFusion.from_state_dict(state | kept)))
        except Exception as e:
            raise Failed("it leaves the mapper in order", "", _printable(f"{type(e).__name__}: {e}")) from None


def _pairs(value: Any) -> list[tuple[int, Any]]:
    if not isinstance(value, list):
        return []
    return [(p[0], p[1]) for p in value if isinstance(p, list) and len(p) == 2 and type(p[0]) is int]


def _parts(rest: list[Any], count: int) -> list[Any]:
    if len(rest) != count:
        raise Failed(ENDED, "", "the process sent something else than an answer")
    return rest


def _signature(parameters: Any) -> inspect.Signature:
    """A signature from what the sandbox says of it.

    Raises:
        ValueError: it says something that no signature is.
    """
    try:
        found = [
            inspect.Parameter(
                str(name), inspect._ParameterKind(kind), default=default if has_default else inspect.Parameter.empty
            )
            for name, kind, has_default, default in parameters
        ]
        return inspect.Signature(found)
    except (TypeError, ValueError) as e:
        raise ValueError(f"no signature: {e}") from None


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)[:300]
