"""What a checkpoint writes of a state: plain values, and tensors as constants or in parts."""

from collections.abc import Callable, Sequence
from typing import IO, Any

import torch
from torch import Tensor

from ..errors import ArgumentError, KindError
from ..resources import MAP_MEMORY

CONSTANT = "$constant"

PARTS = "$parts"

COPIED_BYTES = 1 << 16

PART_BYTES = 1 << 23
"""Of larger tensors the memory is written as it is; still larger ones are written in parts of this
size."""


def plain_values(
    value: Any,
    name: str,
    stored: Callable[[Tensor], Any],
) -> Any:
    """``value`` with what is ``stored`` in place of each tensor. Raises ``TypeError`` for what
    cannot be saved."""
    if isinstance(value, Tensor):
        return stored(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is dict:
        for key in value:
            if type(key) is not str or key in (CONSTANT, PARTS):
                raise KindError(f"{name} must have strings as keys, got {key!r}")
        return {key: plain_values(v, f"{name}[{key!r}]", stored) for key, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(plain_values(v, f"{name}[{i}]", stored) for i, v in enumerate(value))
    raise KindError(
        f"{name} must be a tensor, number, string, None, or a dict, list or tuple of those, got "
        f"{type(value)}"
    )


class FileThatGivesBack:
    """A file; after each tensor that is written to it, its memory may be given back."""

    def __init__(self, file: IO[bytes]):
        self._file = file

    def write(self, data: Any) -> int:
        n = self._file.write(data)
        MAP_MEMORY.give_back()
        return n

    def flush(self) -> None:
        self._file.flush()


def is_one_part(tensor: Tensor) -> bool:
    """Whether a tensor is written as a whole."""
    return tensor.nbytes <= PART_BYTES


def parts_of(tensor: Tensor) -> Sequence[Tensor]:
    """The parts that a large tensor is written in, each with a buffer of its own."""
    return [
        on_disk(part) for part in tensor.split(max(1, PART_BYTES * len(tensor) // tensor.nbytes))
    ]


def joined(parts: list[Tensor]) -> Tensor:
    """The tensor whose ``parts_of`` these are."""
    sizes = [len(part) for part in parts]
    first = parts[0]
    whole = MAP_MEMORY.rows(
        sum(sizes),
        *first.shape[1:],
        dtype=first.dtype,
        device=first.device,
    )
    for place, part in zip(whole.split(sizes), parts, strict=True):
        place.copy_(part)
        MAP_MEMORY.give_back()
    return whole


def on_disk(tensor: Tensor) -> Tensor:
    """The tensor on the CPU, as a buffer of its own size: torch saves whole buffers."""
    plain = tensor.detach().cpu().contiguous()
    if plain.nbytes < COPIED_BYTES:
        return plain.clone()
    # NumPy does not know all types
    values = torch.from_numpy(plain.view(-1).view(torch.uint8).numpy())
    return values.view(plain.dtype).view(plain.shape)


def check_buffers(value: Any, name: str) -> None:
    """Raise ``ValueError`` for a tensor that stands for more memory than it has, as one with a
    stride of 0."""
    if isinstance(value, Tensor):
        if value.nbytes > value.untyped_storage().nbytes():
            raise ArgumentError(
                f"{name} has a tensor {list(value.shape)} of more values than are stored for it"
            )
    elif isinstance(value, dict):
        for part in value.values():
            check_buffers(part, name)
    elif isinstance(value, list | tuple):
        for part in value:
            check_buffers(part, name)


def joined_bytes(value: Any, constants: dict[str, Tensor]) -> int:
    """Memory that the tensors in parts take when they are joined; a part may occur several
    times."""
    if isinstance(value, dict):
        if PARTS in value:
            return sum(constants[place].nbytes for place in value[PARTS])
        return sum(joined_bytes(part, constants) for part in value.values())
    if isinstance(value, list | tuple):
        return sum(joined_bytes(part, constants) for part in value)
    return 0


def whole_values(value: Any, constants: dict[str, Tensor]) -> Any:
    """The state that ``plain_values`` was given. Raises ``KeyError`` for a constant that is
    nowhere."""
    if type(value) is dict:
        if CONSTANT in value:
            return constants[value[CONSTANT]]
        if PARTS in value:
            return joined([constants[place] for place in value[PARTS]])
        return {key: whole_values(v, constants) for key, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(whole_values(v, constants) for v in value)
    return value
