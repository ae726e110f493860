"""Starting a kernel on a GPU, whatever it is written in: where its tensors are, and how many programs it takes."""

import torch
from torch import Tensor


def one_device(operation: str, tensors: dict[str, Tensor | None]) -> torch.device:
    """The device of all ``tensors``; ``ValueError`` if they are on several."""
    found = {name: value.device for name, value in tensors.items() if value is not None}
    devices = set(found.values())
    if len(devices) > 1:
        places = ", ".join(f"{name} on {device}" for name, device in found.items())
        raise ValueError(f"{operation}: all tensors must be on one device, got {places}")
    return devices.pop()


def parts(count: int, size: int) -> int:
    """Blocks of threads, or programs, needed for ``count`` items, ``size`` in each."""
    return -(-count // size)
