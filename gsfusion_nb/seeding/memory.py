"""What a seeding rule keeps from one frame to the next: only what can be saved; a loop closure
moves it."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..checks import shown
from ..errors import KindError

_PLAIN = (type(None), bool, int, float, str)

_RESERVED = "$"
"""Checkpoints use this key themselves."""

_WORLD = {"xyz_W": (3,), "normal_W": (3,), "T_WC": (4, 4)}
"""Names of values in world coordinates, and the shape of a row: points, directions, camera-to-world
poses."""


def check_memory(rule: str, memory: Any, name: str = "memory") -> None:
    """Raise ``TypeError``, with the place, unless ``memory`` holds only what a checkpoint can save.

    Args:
        rule: Name of the rule, for the message.
        memory: A dict with strings as keys; tensors, None, True/False, numbers, words, and lists,
            tuples and dicts of these.
        name: What it is called in the message.
    """
    if type(memory) is dict:
        for key, value in memory.items():
            if type(key) is not str or key == _RESERVED:
                raise KindError(
                    f"seeding rule {rule!r}: the keys of its {name} must be words, got {shown(key)}"
                )
            check_memory(rule, value, f"{name}[{key!r}]")
        _check_world(rule, memory, name)
    elif type(memory) in (list, tuple):
        for i, value in enumerate(memory):
            check_memory(rule, value, f"{name}[{i}]")
    elif not isinstance(memory, Tensor) and type(memory) not in _PLAIN:
        raise KindError(
            f"seeding rule {rule!r} keeps a {type(memory).__name__} in its {name}, which a "
            "checkpoint cannot save; expected tensors, numbers, True/False, words, None, and "
            "lists, tuples and dicts of these"
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
        return a.keys() == b.keys() and all(
            equal_memories(value, b[key]) for key, value in a.items()
        )
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal_memories, a, b))
    return a == b or (a != a and b != b)


def move_memory(
    memory: Any, transform_of: Callable[[Int[Tensor, " N"]], Float[Tensor, "N 4 4"]]
) -> None:
    """Move the values in world coordinates with the map, in place, as a loop closure moves
    Gaussians and keyframes.

    Args:
        memory: What a rule keeps. In each dict in it, the values with the names ``xyz_W`` (points),
            ``normal_W`` (directions) and ``T_WC`` (poses) are moved, each row with the frame that
            ``frame_index`` says.
        transform_of: Frames -> world-to-world motions (``Correction.transform_of``).
    """
    if not isinstance(memory, (dict, list, tuple)):
        return
    if isinstance(memory, dict) and (names := _WORLD.keys() & memory.keys()):
        T = transform_of(memory["frame_index"])
        for name in names:
            value = memory[name]
            turn = T.to(value)
            if name == "T_WC":
                memory[name] = turn @ value
            else:
                directions = (turn[:, :3, :3] @ value[:, :, None]).squeeze(2)
                memory[name] = directions + turn[:, :3, 3] if name == "xyz_W" else directions
    for value in memory.values() if isinstance(memory, dict) else memory:
        move_memory(value, transform_of)


def _check_world(rule: str, memory: dict[str, Any], name: str) -> None:
    """Raise ``TypeError`` for values in world coordinates without the frame of each row, by which
    they are moved."""
    for key in _WORLD.keys() & memory.keys():
        value = memory[key]
        frame = memory.get("frame_index")
        n = (
            len(frame)
            if isinstance(frame, Tensor) and frame.ndim == 1 and not frame.is_floating_point()
            else -1
        )
        if not isinstance(value, Tensor) or tuple(value.shape) != (n, *_WORLD[key]):
            raise KindError(
                f"seeding rule {rule!r}: {name}[{key!r}] is moved when a loop closes, so it must "
                f"be a tensor [N, {', '.join(map(str, _WORLD[key]))}] beside "
                f"{name}['frame_index'], an int64 tensor [N] with ctx.frame.index for each row"
            )
