"""What crosses between the judge and a submission: numbers, texts, arrays, lists and dicts, in a
format that executes nothing.

A message is eight bytes of length, and a document. The document is JSON, in which a tensor stands
as its type, shape and place, followed by the bytes of all tensors::

    length of the JSON (8 bytes) | {"value": ..., "sizes": [bytes of each buffer]} | buffers

Of the library's objects only ``Camera`` and ``Seeds`` are built again, from their fields; of
another one the name of its class is left.
"""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import ArgumentError
from ...types import Camera, Seeds

LARGEST_BYTES = 64 << 20
"""Of a message."""
_LARGEST_HEAD = 8 << 20
"""Of the JSON in it: what is not an array."""
_MOST_KEYS = 20_000
"""Entries of all sets and dicts of a message. Keys with equal hashes, which anybody can choose,
take a time that grows with the square of their number."""
LONGEST_WORDS = 2000
"""Characters of what is said of a submission."""
LENGTH = struct.Struct("<Q")

_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
        *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
        *(torch.complex64, torch.complex128),
    )
}
_SEQUENCES: dict[str, Any] = {
    "list": list,
    "tuple": tuple,
    "set": set,
    "frozenset": frozenset,
}
_WITH_KEYS = ("set", "frozenset", "dict")
_OBJECTS = {"Camera": Camera, "Seeds": Seeds}


class DataError(ArgumentError):
    """A value that cannot cross, or bytes that are no message."""


def cut(value: Any, longest: int = LONGEST_WORDS) -> str:
    """A text of a submission, not too long."""
    text = str(value)
    return text if len(text) <= longest else f"{text[:longest]} ... ({len(text):,} characters)"


def encode(value: Any) -> bytes:
    """A message.

    Raises:
        DataError: it holds something else than data, or is too large.
    """
    buffers: list[bytes] = []
    try:
        tree = _tree(value, buffers)
        head = json.dumps({"value": tree, "sizes": [len(b) for b in buffers]}).encode()
    except (RecursionError, ValueError, RuntimeError, TypeError) as e:
        raise DataError(f"it is no plain value: {e}") from None
    length = LENGTH.size + len(head) + sum(map(len, buffers))
    if length > LARGEST_BYTES:
        raise DataError(f"it has {length:,} bytes, more than {LARGEST_BYTES:,}")
    return b"".join([LENGTH.pack(length), LENGTH.pack(len(head)), head, *buffers])


def decode(document: bytes | bytearray) -> Any:
    """The value of a document: a message without its first eight bytes.

    Raises:
        DataError: it is not what ``encode`` writes.
    """
    try:
        (size,) = LENGTH.unpack_from(document)
        start = LENGTH.size + size
        if size > _LARGEST_HEAD:
            raise DataError(
                f"it has {size:,} bytes besides its arrays, more than {_LARGEST_HEAD:,}"
            )
        head = json.loads(document[LENGTH.size : start])
        buffers = []
        for length in head["sizes"]:
            if type(length) is not int or length < 0:
                raise DataError("the length of a buffer is not a whole number")
            buffers.append(document[start : start + length])
            start += length
        if start != len(document):
            raise DataError("the buffers are not as long as it says")
        if _count_keys(head["value"]) > _MOST_KEYS:
            raise DataError(f"its sets and dicts have more than {_MOST_KEYS:,} entries")
        return _value(head["value"], buffers)
    except DataError:
        raise
    except Exception as e:  # bytes of a stranger
        raise DataError(f"it is no message: {type(e).__name__}") from None


def _tree(value: Any, buffers: list[bytes]) -> Any:
    """What stands in the JSON; plain numbers and words as they are, all else as ``{kind: ...}``."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, Tensor):
        return _tensor_tree(value, buffers)
    if isinstance(value, np.ndarray):
        return {"array": _tensor_tree(torch.from_numpy(np.ascontiguousarray(value)), buffers)}
    if isinstance(value, (bytes, bytearray)):
        buffers.append(bytes(value))
        return {"bytes": len(buffers) - 1}
    if value is Ellipsis:
        return {"ellipsis": 0}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    for name, kind in _SEQUENCES.items():
        if isinstance(value, kind):
            return {name: [_tree(part, buffers) for part in value]}
    if isinstance(value, dict):
        return {"dict": [[_tree(k, buffers), _tree(v, buffers)] for k, v in value.items()]}
    for kind in (bool, int, float, str):  # of a class derived from it
        if isinstance(value, kind):
            return kind(value)
    name = type(value).__name__
    if type(value) in _OBJECTS.values():
        return {"object": name, "fields": _tree(dict(vars(value)), buffers)}
    return {"foreign": name}


def _tensor_tree(value: Tensor, buffers: list[bytes]) -> dict[str, Any]:
    plain = value.detach().to_dense() if value.layout != torch.strided else value.detach()
    plain = plain.cpu().resolve_conj().resolve_neg().contiguous()
    buffers.append(plain.flatten().view(torch.uint8).numpy().tobytes() if plain.numel() else b"")
    return {
        "tensor": len(buffers) - 1,
        "dtype": str(plain.dtype).removeprefix("torch."),
        "shape": list(plain.shape),
    }


def _count_keys(tree: Any) -> int:
    """Entries of all sets and dicts in a tree; nothing is hashed."""
    count = 0
    rest = [tree]
    while rest:
        part = rest.pop()
        if isinstance(part, list):
            rest += part
        elif isinstance(part, dict):
            count += sum(len(part.get(kind, ())) for kind in _WITH_KEYS)
            rest += part.values()
    return count


def _value(tree: Any, buffers: Sequence[bytes | bytearray]) -> Any:
    if not isinstance(tree, dict):
        if tree is None or type(tree) in (bool, int, float, str):
            return tree
        raise DataError("a list stands where a value should")
    if "tensor" in tree:
        return _tensor(tree, buffers)
    if "object" in tree:
        return _OBJECTS[tree["object"]](**_value(tree["fields"], buffers))
    ((kind, content),) = tree.items()
    if kind in _SEQUENCES:
        return _SEQUENCES[kind]([_value(part, buffers) for part in content])
    if kind == "dict":
        return {_value(k, buffers): _value(v, buffers) for k, v in content}
    if kind == "array":
        return _tensor(content, buffers).numpy()
    if kind == "bytes":
        return bytes(buffers[content])
    if kind == "complex":
        return complex(*content)
    if kind == "ellipsis":
        return Ellipsis
    if kind == "foreign":
        return _foreign(content)
    raise DataError(f"there is no kind {kind!r}")


def _tensor(tree: dict[str, Any], buffers: Sequence[bytes | bytearray]) -> Tensor:
    dtype = _DTYPES[tree["dtype"]]
    data = bytearray(buffers[tree["tensor"]])
    if not data:
        return torch.empty(0, dtype=dtype).reshape(tree["shape"])
    return torch.frombuffer(data, dtype=torch.uint8).view(dtype).reshape(tree["shape"])


def _foreign(name: str) -> Any:
    """An object of which only the name of its class is known."""
    return type("".join(c for c in str(name)[:80] if c.isidentifier() or c.isdigit()), (), {})()
