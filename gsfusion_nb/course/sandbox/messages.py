"""Messages over a socket, and the values that a sandbox may send in them.

These are numbers, text, tensors, arrays, containers, and ``Seeds``. ``pickle`` would execute what a submission wrote.
So a message is JSON with the bytes of tensors after it.
"""

import itertools
import json
import math
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...types import Seeds

LARGEST_BYTES = 32 << 20
"""Of one message."""
_DEEPEST = 16
_LONGEST = 1_000_000
"""Of what a generator yields."""
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.float16, torch.float32,
        torch.float64,
    )
}  # fmt: skip
_SEEDS = ("xyz_W", "rgb", "scale_m", "quat", "opacity", "tag")


class CodecError(ValueError):
    """A message that cannot be sent, or is damaged."""


class Foreign:
    """Stands in for an object that is not sent; its class has the name of the object's class."""


def encode(value: Any) -> bytes:
    """``value`` as bytes; what cannot be sent becomes a ``Foreign`` of its class's name.

    Raises:
        CodecError: nested too deeply, or larger than ``LARGEST_BYTES``.
    """
    buffers: list[bytes] = []
    head = json.dumps(_tree(value, buffers, 0)).encode()
    message = b"".join([struct.pack(">I", len(head)), head, *buffers])
    if len(message) > LARGEST_BYTES:
        raise CodecError(f"{len(message) / 2**20:.0f} MB, more than the {LARGEST_BYTES >> 20} MB of a message")
    return message


def decode(message: bytes) -> Any:
    """What ``encode`` was given.

    Raises:
        CodecError: the message is damaged.
    """
    try:
        (length,) = struct.unpack_from(">I", message)
        return _value(json.loads(message[4 : 4 + length]), memoryview(message)[4 + length :], 0)
    except CodecError:
        raise
    except Exception as e:  # whatever a forged message makes of it
        raise CodecError(f"a damaged message ({type(e).__name__})") from None


def _tree(value: Any, buffers: list[bytes], depth: int) -> Any:
    """JSON of ``value``; the bytes of arrays go to ``buffers``."""
    if depth > _DEEPEST:
        raise CodecError(f"more than {_DEEPEST} containers inside each other")
    if value is None or isinstance(value, (bool, int, float, str)):
        return value if type(value) in (bool, int, float, str, type(None)) else _plainest(value)
    if isinstance(value, Tensor):
        return _tensor_tree(value, buffers)
    if isinstance(value, np.generic):
        return _tree(value.item(), buffers, depth) if value.dtype.kind in "biuf" else ["?", type(value).__name__]
    if isinstance(value, np.ndarray):
        return ["A", *_array_tree(value, buffers)] if value.dtype.kind in "biuf" else ["?", "ndarray"]
    if isinstance(value, Seeds):
        return ["S", [_tree(getattr(value, name), buffers, depth + 1) for name in _SEEDS]]
    for kind, letter in ((tuple, "t"), (list, "l"), (set, "s"), (frozenset, "s")):
        if isinstance(value, kind):
            return [letter, [_tree(v, buffers, depth + 1) for v in value]]
    if isinstance(value, Iterator):
        return ["l", [_tree(v, buffers, depth + 1) for v in itertools.islice(value, _LONGEST)]]
    if isinstance(value, Mapping):
        return ["d", [[_tree(k, buffers, depth + 1), _tree(v, buffers, depth + 1)] for k, v in value.items()]]
    return ["?", type(value).__name__]


def _plainest(value: Any) -> Any:
    """A number or text of a derived class as one of the class itself."""
    return next(kind(value) for kind in (bool, int, float, str) if isinstance(value, kind))


def _tensor_tree(value: Tensor, buffers: list[bytes]) -> list:
    name = str(value.dtype).removeprefix("torch.")
    if value.layout != torch.strided or name not in _DTYPES:
        return ["?", "Tensor"]
    return ["T", *_array_tree(value.detach().cpu().resolve_conj().resolve_neg().contiguous().numpy(), buffers)]


def _array_tree(value: np.ndarray, buffers: list[bytes]) -> list:
    start = sum(map(len, buffers))
    if start + value.nbytes > LARGEST_BYTES:
        raise CodecError(f"more than the {LARGEST_BYTES >> 20} MB of a message")
    buffers.append(np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<")).tobytes())
    return [value.dtype.name, list(value.shape), start]


def _value(tree: Any, data: memoryview, depth: int) -> Any:
    if depth > _DEEPEST:
        raise CodecError("nested too deeply")
    if not isinstance(tree, list):
        if isinstance(tree, dict):
            raise CodecError("an object where a value was expected")
        return tree
    letter, *rest = tree
    if letter == "T":
        return torch.from_numpy(_array(rest, data))
    if letter == "A":
        return _array(rest, data)
    if letter == "?":
        name = "".join(c for c in str(rest[0])[:40] if c.isalnum() or c == "_")
        return type(name if name.isidentifier() else "object", (Foreign,), {})()
    if letter == "d":
        return {_value(k, data, depth + 1): _value(v, data, depth + 1) for k, v in rest[0]}
    values = [_value(v, data, depth + 1) for v in rest[0]]
    if letter == "S":
        return Seeds(**dict(zip(_SEEDS, values, strict=True)))
    return {"t": tuple, "l": list, "s": set}[letter](values)


def _array(about: list[Any], data: memoryview) -> np.ndarray:
    name, shape, start = about
    if name not in _DTYPES and name not in ("uint16", "uint32", "uint64"):
        raise CodecError(f"an array of {name!r}")
    if not all(type(n) is int and n >= 0 for n in [*shape, start]):
        raise CodecError("a negative size")
    dtype = np.dtype(name)
    end = start + math.prod(shape) * dtype.itemsize
    if end > len(data):
        raise CodecError("an array longer than its message")
    return np.frombuffer(data[start:end], dtype.newbyteorder("<")).astype(dtype).reshape(shape)


class ChannelClosed(ConnectionError):
    """The other side has gone."""


class TooSlow(TimeoutError):
    """No whole message came in time."""


class TooLarge(ValueError):
    """A message is announced that is larger than allowed."""


def send(to: socket.socket, message: bytes) -> None:
    """Send one message.

    Raises:
        ChannelClosed: the other side has gone.
    """
    try:
        to.sendall(struct.pack(">Q", len(message)) + message)
    except TimeoutError:
        raise TooSlow from None
    except OSError as e:
        raise ChannelClosed(str(e)) from None


def receive(source: socket.socket, *, until: float | None = None, largest: int = LARGEST_BYTES) -> bytes:
    """The next message.

    Args:
        until: Time of ``time.monotonic`` at which waiting ends; without it, never.
        largest: Most bytes of a message.

    Raises:
        ChannelClosed, TooSlow, TooLarge
    """
    (length,) = struct.unpack(">Q", _exactly(source, 8, until))
    if length > largest:
        raise TooLarge(f"{length} bytes")
    return _exactly(source, length, until)


def _exactly(source: socket.socket, count: int, until: float | None) -> bytes:
    parts = bytearray()
    while len(parts) < count:
        left = None if until is None else until - time.monotonic()
        if left is not None and left <= 0:
            raise TooSlow
        source.settimeout(left)
        try:
            part = source.recv(min(count - len(parts), 1 << 20))
        except TimeoutError:
            raise TooSlow from None
        except OSError as e:
            raise ChannelClosed(str(e)) from None
        if not part:
            raise ChannelClosed
        parts += part
    return bytes(parts)
