"""Arguments on their way from the judge to a submission.

The judge is trusted, so what it passes is pickled, objects of the library included. Tensors,
arrays, generators, maps and functions are taken out and numbered: the first four come back if
the submission changes them, and a function stays with the judge, who calls it when asked. What
comes back is data (``data.py``).
"""

import importlib
import io
import pickle
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .data import DataError

Call = Callable[[int, Sequence[Any]], Any]
"""Asks the judge to call function number n."""


class Outgoing:
    """Arguments of one call as the judge sends them."""

    def __init__(self, args: Sequence[Any], kwargs: Mapping[str, Any]):
        self.arguments = [*args, *kwargs.values()]
        self.parts: list[tuple[str, Any]] = []
        """Kind and value of each numbered part."""
        self._numbers: dict[int, int] = {}
        stream = io.BytesIO()
        _Pickler(stream, self).dump((list(args), dict(kwargs)))
        self.message = {
            "pickle": stream.getvalue(),
            "parts": [[kind, _PACK[kind](value)] for kind, value in self.parts],
        }

    def number(self, kind: str, value: Any) -> int:
        """The number of a part."""
        if id(value) not in self._numbers:
            self._numbers[id(value)] = len(self.parts)
            self.parts.append((kind, value))
        return self._numbers[id(value)]

    def call(self, number: int, args: Sequence[Any]) -> Any:
        """Call function ``number`` for the submission."""
        kind, function = self.parts[number]
        if kind != "function":
            raise DataError("it called what is no function")
        return function(*args)

    def take_back(self, changes: Any) -> None:
        """Make the changes that the submission made to its arguments, which are copies, and to
        generators.

        Raises:
            DataError: a change that is not possible, or of a part of an argument, such as the
                picture in a frame: the judge may still need it.
        """
        try:
            for number, value in changes["parts"].items():
                kind, part = self.parts[number]
                if kind != "generator" and not any(part is each for each in self.arguments):
                    raise DataError("a part of what was passed in has changed; work on a copy")
                _CHANGE[kind](part, value)
            for position, value in changes["arguments"].items():
                _change_argument(self.arguments[position], value)
        except DataError:
            raise
        except (KeyError, IndexError, TypeError, ValueError, RuntimeError, AttributeError) as e:
            raise DataError(f"it changed its inputs to something impossible: {e}") from None


class _Pickler(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, outgoing: Outgoing):
        super().__init__(stream, protocol=5)
        self._outgoing = outgoing

    def persistent_id(self, obj: Any) -> int | None:
        kind = _kind_of(obj)
        return None if kind is None else self._outgoing.number(kind, obj)


def _kind_of(value: Any) -> str | None:
    if isinstance(value, Tensor):
        return "tensor"
    if isinstance(value, np.ndarray):
        return "array"
    if isinstance(value, torch.Generator):
        return "generator"
    if isinstance(value, (types.FunctionType, types.MethodType)) and (
        "<" in value.__qualname__ or ".course." in str(value.__module__)
    ):
        return "function"
    is_map = any(base.__name__ in ("Mapper", "TsdfVolume") for base in type(value).__mro__)
    return "map" if is_map else None


def _pack_map(value: Any) -> list[Any]:
    return [type(value).__module__, type(value).__qualname__, value.state_dict()]


def _made_map(kind: Any, state: Any) -> Any:
    if hasattr(kind, "from_state_dict"):
        return kind.from_state_dict(state)
    from ...config import TsdfConfig  # takes a second, and few exercises are about a volume

    volume = kind(TsdfConfig(**state["config"]))
    volume.load_state_dict(state)
    return volume


_PACK: dict[str, Callable[[Any], Any]] = {
    "tensor": lambda value: value,
    "array": lambda value: value,
    "generator": lambda value: value.get_state(),
    "function": lambda value: None,
    "map": _pack_map,
}


def _change_tensor(old: Tensor, new: Tensor) -> None:
    if old.shape != new.shape or old.dtype != new.dtype:
        raise DataError(f"a tensor of {list(old.shape)} became one of {list(new.shape)}")
    old.detach().copy_(new)


def _change_array(old: np.ndarray, new: np.ndarray) -> None:
    old[...] = new


def _change_map(old: Any, state: Any) -> None:
    vars(old).update(vars(_made_map(type(old), state)))


_CHANGE: dict[str, Callable[[Any, Any], None]] = {
    "tensor": _change_tensor,
    "array": _change_array,
    "generator": lambda old, state: old.set_state(state),
    "map": _change_map,
}


def _change_argument(old: Any, new: Any) -> None:
    if isinstance(old, list):
        old[:] = list(new)
    elif isinstance(old, dict):
        old.clear()
        old.update(dict(new))
    else:
        old.load_state_dict(new)


class Incoming:
    """Arguments of one call in the process of the submission."""

    def __init__(self, message: Mapping[str, Any], call: Call):
        self.parts = [_unpack(i, k, v, call) for i, (k, v) in enumerate(message["parts"])]
        self._kinds = [kind for kind, _ in message["parts"]]
        unpickler = _Unpickler(io.BytesIO(message["pickle"]), self.parts)
        self.args, self.kwargs = unpickler.load()
        self._before = [_state(k, p) for k, p in zip(self._kinds, self.parts, strict=True)]
        self._arguments = [*self.args, *self.kwargs.values()]
        self._arguments_before = [_argument_state(a) for a in self._arguments]

    def changes(self) -> dict[str, Any]:
        """What the submission changed: parts by number, arguments by position."""
        parts = zip(self._kinds, self.parts, self._before, strict=True)
        now = [(_state(kind, part), before) for kind, part, before in parts]
        arguments = zip(map(_argument_state, self._arguments), self._arguments_before, strict=True)
        return {
            "parts": {i: new for i, (new, old) in enumerate(now) if not _equal(new, old)},
            "arguments": {i: new for i, (new, old) in enumerate(arguments) if not _equal(new, old)},
        }


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, parts: Sequence[Any]):
        super().__init__(stream)
        self._parts = parts

    def persistent_load(self, pid: Any) -> Any:
        return self._parts[pid]


def _unpack(number: int, kind: str, value: Any, call: Call) -> Any:
    if kind == "generator":
        generator = torch.Generator()
        generator.set_state(value)
        return generator
    if kind == "function":
        return lambda *args: call(number, args)
    if kind == "map":
        module, name, state = value
        return _made_map(getattr(importlib.import_module(module), name), state)
    return value


def _state(kind: str, part: Any) -> Any:
    """A copy of what may change."""
    if kind == "tensor":
        return part.detach().clone()
    if kind == "array":
        return part.copy()
    if kind == "generator":
        return part.get_state()
    return part.state_dict() if kind == "map" else None


def _argument_state(value: Any) -> Any:
    if isinstance(value, list):
        return list(value)
    if isinstance(value, dict):
        return dict(value)
    is_noted = hasattr(value, "load_state_dict") and hasattr(value, "state_dict")
    return value.state_dict() if is_noted else None


def _equal(a: Any, b: Any) -> bool:
    """Whether two states are the same; where that cannot be said, they are not."""
    if type(a) is not type(b):
        return False
    if isinstance(a, Tensor):
        same = a.shape == b.shape and a.dtype == b.dtype
        return same and torch.equal(a.nan_to_num(), b.nan_to_num())
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(value, b[key]) for key, value in a.items())
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(_equal, a, b))
    try:
        return bool(a == b)
    except Exception:  # an object of the submission
        return False
