"""A state as plain values for JSON, with its tensors stored separately, and back."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import check_whole
from ..errors import shown

SMALL_BYTES = 1 << 12
"""Tensors below this size are written together, as one."""
_TAG = "$"
_DTYPES = {str(t).removeprefix("torch."): t for t in (
    torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8,
    torch.uint8, torch.bool,
)}  # fmt: skip


class Packing:
    """Turns a state into JSON with tensors stored separately: large ones in a list, small ones in one buffer."""

    def __init__(self):
        self.large: list[Tensor] = []
        self.small = bytearray()

    def plain(self, value: Any, name: str) -> Any:
        """``value`` for JSON. Raises ``TypeError``, with the place, for a type that cannot be saved."""
        if isinstance(value, Tensor):
            return self._tensor(value.detach() if value.requires_grad else value)
        if value is None or type(value) in (bool, int, float, str):
            return value
        if type(value) is dict:
            for key in value:
                if type(key) is not str or key == _TAG:
                    raise TypeError(f"{name} must have strings as keys, got {key!r}")
            return {key: self.plain(v, f"{name}[{key!r}]") for key, v in value.items()}
        if type(value) in (list, tuple):
            items = [self.plain(v, f"{name}[{i}]") for i, v in enumerate(value)]
            return items if type(value) is list else {_TAG: "tuple", "items": items}
        raise TypeError(
            f"{name} must be a tensor, number, string, None, or a dict, list or tuple of those, got {type(value)}"
        )

    def _tensor(self, value: Tensor) -> dict[str, Any]:
        if value.nbytes >= SMALL_BYTES:
            self.large.append(value)
            return {_TAG: "tensor", "n": len(self.large) - 1}
        at = len(self.small)
        self.small += bytes_of(value).tobytes()
        dtype = str(value.dtype).removeprefix("torch.")
        return {_TAG: "small", "dtype": dtype, "shape": list(value.shape), "at": at}


def unpack(value: Any, tensors: list[Tensor], small: bytes, device: torch.device | str) -> Any:
    """The state that ``Packing.plain`` was given. Raises ``ValueError`` for missing tensors."""
    if type(value) is list:
        return [unpack(v, tensors, small, device) for v in value]
    if type(value) is not dict:
        return value
    kind = value.get(_TAG)
    if kind == "tuple":
        return tuple(unpack(v, tensors, small, device) for v in value["items"])
    if kind == "tensor":
        check_whole("number of a tensor", value["n"], 0, len(tensors) - 1)
        return tensors[value["n"]]
    if kind == "small":
        check_whole("place of a tensor", value["at"], 0, len(small))
        size = _DTYPES[value["dtype"]].itemsize * math.prod(value["shape"])
        return tensor_of(value["dtype"], value["shape"], small[value["at"] : value["at"] + size], device)
    if kind is not None:
        raise ValueError(f"it contains a value of the unknown kind {shown(kind)}")
    return {key: unpack(v, tensors, small, device) for key, v in value.items()}


def tensor_of(dtype: str, shape: list[int], content: bytes, device: torch.device | str) -> Tensor:
    """A tensor from the bytes of its numbers, row by row. Raises ``ValueError`` if their number does not fit."""
    for side in shape:
        check_whole("side of a tensor", side, 0)
    if len(content) != _DTYPES[dtype].itemsize * math.prod(shape):
        raise ValueError(f"a tensor {shape} of {dtype} cannot have {len(content)} bytes")
    if dtype == "bool" and content and np.frombuffer(content, np.uint8).max() > 1:
        raise ValueError("a boolean tensor must hold 0 and 1")
    flat = (
        torch.frombuffer(bytearray(content), dtype=_DTYPES[dtype]) if content else torch.zeros(0, dtype=_DTYPES[dtype])
    )
    return flat.reshape(shape).to(device)


def bytes_of(tensor: Tensor) -> np.ndarray:
    """The bytes of a tensor's numbers, row by row."""
    flat = tensor.detach().cpu().contiguous().reshape(-1)
    if flat.stride() != (1,):  # a single element of an expanded tensor
        flat = torch.empty(flat.shape, dtype=flat.dtype).copy_(flat)
    return flat.view(torch.uint8).numpy()
