"""Starting a kernel on a GPU, whatever it is written in: where its tensors are, and how many programs it takes."""

import torch
from torch import Tensor

_ALIGNMENT = 16
"""Bytes: rows are read four numbers at a time."""


def one_device(operation: str, tensors: dict[str, Tensor | None]) -> torch.device:
    """The device of all ``tensors``; ``ValueError`` if they are on several."""
    found = {name: value.device for name, value in tensors.items() if value is not None}
    devices = set(found.values())
    if len(devices) > 1:
        places = ", ".join(f"{name} on {device}" for name, device in found.items())
        raise ValueError(f"{operation}: all tensors must be on one device, got {places}")
    return devices.pop()


def check_dtype(operation: str, dtype: torch.dtype, **tensors: Tensor | None) -> None:
    """Raise ``ValueError`` unless all ``tensors`` hold numbers of type ``dtype``."""
    for name, value in tensors.items():
        if value is not None and value.dtype != dtype:
            raise ValueError(f"{operation}: {name} must be {dtype}, got {value.dtype}")


def packed(tensor: Tensor) -> Tensor:
    """The same values without gaps, from an address that is a multiple of 16 bytes; a copy only where needed."""
    tensor = tensor.detach().contiguous()
    return tensor if tensor.data_ptr() % _ALIGNMENT == 0 else tensor.clone()


def as_bytes(mask: Tensor | None) -> Tensor | None:
    """A boolean mask as uint8, which kernels read; ``None`` stays."""
    return None if mask is None else packed(mask).view(torch.uint8)


def parts(count: int, size: int) -> int:
    """Blocks of threads, or programs, needed for ``count`` items, ``size`` in each."""
    return -(-count // size)
