"""What a seeding rule keeps from one frame to the next: checked, copied, and described in one line."""

from typing import Any

import torch
from torch import Tensor

from ..errors import shown

_PLAIN = (type(None), bool, int, float, str)
_RESERVED = "$"
"""Checkpoints use this key themselves."""


def check_memory(rule: str, memory: Any, name: str = "memory") -> None:
    """Raise ``TypeError``, with the place, unless ``memory`` holds only what a checkpoint can save.

    Args:
        rule: Name of the rule, for the message.
        memory: A dict with strings as keys; tensors, None, True/False, numbers, words, and lists, tuples and dicts of
            these.
        name: What it is called in the message.
    """
    if type(memory) is dict:
        for key, value in memory.items():
            if type(key) is not str or key == _RESERVED:
                raise TypeError(f"seeding rule {rule!r}: the keys of its {name} must be words, got {shown(key)}")
            check_memory(rule, value, f"{name}[{key!r}]")
    elif type(memory) in (list, tuple):
        for i, value in enumerate(memory):
            check_memory(rule, value, f"{name}[{i}]")
    elif not isinstance(memory, Tensor) and type(memory) not in _PLAIN:
        raise TypeError(
            f"seeding rule {rule!r} keeps a {type(memory).__name__} in its {name}, which a checkpoint cannot save; "
            "expected tensors, numbers, True/False, words, None, and lists, tuples and dicts of these"
        )


def copy_memory(memory: Any) -> Any:
    """A copy that shares nothing with ``memory``."""
    if isinstance(memory, Tensor):
        return memory.clone()
    if isinstance(memory, dict):
        return {key: copy_memory(value) for key, value in memory.items()}
    if isinstance(memory, (list, tuple)):
        return type(memory)(copy_memory(value) for value in memory)
    return memory


def equal_memories(a: Any, b: Any) -> bool:
    """Whether two memories hold the same values, bit for bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal_memories(value, b[key]) for key, value in a.items())
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal_memories, a, b))
    return a == b or (a != a and b != b)


def describe_memory(memory: dict[str, Any]) -> str:
    """The names in a memory and the size of each: "occupied 1,024 x 3 int64, calls 12"; "empty" without any."""
    return ", ".join(f"{name} {_size(value)}" for name, value in memory.items()) or "empty"


def _size(value: Any) -> str:
    if isinstance(value, Tensor):
        sides = " x ".join(f"{side:,}" for side in value.shape)
        return " ".join(filter(None, (sides, str(value.dtype).removeprefix("torch."))))
    if isinstance(value, (dict, list, tuple)):
        return f"({len(value):,} values)"
    return shown(value)
