"""Where the kernels run: on CUDA tensors, or on CPU tensors under Triton's interpreter."""

import torch
import triton
from torch import Tensor
from triton.runtime import JITFunction

from gsfusion_nb.backends import BackendUnavailable

from ..gpu import one_device
from ..gpu import parts as parts


@triton.jit
def _nothing():
    pass


INTERPRETED = not isinstance(_nothing, JITFunction)
"""Triton decides once, when a kernel is declared."""


def device_of(operation: str, **tensors: Tensor | None) -> torch.device:
    """The one device of all ``tensors``.

    Raises:
        ValueError: they are on several. BackendUnavailable: Triton does not run there.
    """
    device = one_device(operation, tensors)
    if device.type != "cuda" and not (INTERPRETED and device.type == "cpu"):
        raise BackendUnavailable(
            f"{operation}: backend 'triton' takes CUDA tensors, got tensors on {device}; "
            "for CPU tensors set TRITON_INTERPRET=1 before Python starts (slow, for tests)"
        )
    return device


def launch(kernel, programs: int, device: torch.device, /, **arguments) -> None:
    """Run ``programs`` programs of a kernel on ``device``; none is allowed. Its arguments are given by name."""
    if programs == 0:
        return
    if device.type == "cuda" and device.index not in (None, torch.cuda.current_device()):
        with torch.cuda.device(device):
            kernel[(programs,)](**arguments)
    else:
        kernel[(programs,)](**arguments)
