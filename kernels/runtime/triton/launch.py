"""Where the kernels run: on CUDA tensors, or on CPU tensors under Triton's interpreter.

Reading and writing vectors of three and four numbers, quaternions and poses.

A pose is a matrix [4, 4], row by row: its rotation has the entries 0 to 2, 4 to 6 and 8 to 10, its
position 3, 7 and 11.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.runtime import JITFunction

from gsfusion_nb.backends import BackendUnavailable

from ..arguments import parts as parts


@triton.jit
def _nothing():
    pass


INTERPRETED = not isinstance(_nothing, JITFunction)
"""Triton decides once, when a kernel is declared."""


def device_of(operation: str, tensor: Tensor) -> torch.device:
    """The device of a tensor; the check of the operation has seen that all others are there.

    Raises:
        BackendUnavailable: Triton does not run there.
    """
    device = tensor.device
    if device.type != "cuda" and not (INTERPRETED and device.type == "cpu"):
        raise BackendUnavailable(
            f"{operation}: backend 'triton' takes CUDA tensors, got tensors on {device}; "
            "for CPU tensors set TRITON_INTERPRET=1 before Python starts (slow, for tests)"
        )
    return device


def launch(kernel, programs: int, device: torch.device, /, **arguments) -> None:
    """Run ``programs`` programs of a kernel on ``device``; none is allowed. Its arguments are given
    by name."""
    if programs == 0:
        return
    if device.type == "cuda" and device.index not in (None, torch.cuda.current_device()):
        with torch.cuda.device(device):
            kernel[(programs,)](**arguments)
    else:
        kernel[(programs,)](**arguments)


# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false


@triton.jit
def load3(base, row, mask):
    """Three consecutive numbers of each row."""
    return (
        tl.load(base + 3 * row, mask=mask, other=0.0),
        tl.load(base + 3 * row + 1, mask=mask, other=0.0),
        tl.load(base + 3 * row + 2, mask=mask, other=0.0),
    )


@triton.jit
def store3(base, row, a, b, c, mask):
    """Write three consecutive numbers of each row."""
    tl.store(base + 3 * row, a, mask=mask)
    tl.store(base + 3 * row + 1, b, mask=mask)
    tl.store(base + 3 * row + 2, c, mask=mask)


@triton.jit
def load4(base, row, mask):
    """A quaternion of each row; the identity where the mask is false."""
    return (
        tl.load(base + 4 * row, mask=mask, other=1.0),
        tl.load(base + 4 * row + 1, mask=mask, other=0.0),
        tl.load(base + 4 * row + 2, mask=mask, other=0.0),
        tl.load(base + 4 * row + 3, mask=mask, other=0.0),
    )


@triton.jit
def store4(base, row, a, b, c, d, mask):
    """Write four consecutive numbers of each row."""
    tl.store(base + 4 * row, a, mask=mask)
    tl.store(base + 4 * row + 1, b, mask=mask)
    tl.store(base + 4 * row + 2, c, mask=mask)
    tl.store(base + 4 * row + 3, d, mask=mask)


@triton.jit
def rotation(w, x, y, z):
    """|q|, and the entries of R(q / |q|) row by row."""
    norm = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w = w / norm
    x = x / norm
    y = y / norm
    z = z / norm
    return (
        norm,
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@triton.jit
def load_rotation(T):
    """R_WC of a pose, row by row."""
    return (
        tl.load(T),
        tl.load(T + 1),
        tl.load(T + 2),
        tl.load(T + 4),
        tl.load(T + 5),
        tl.load(T + 6),
        tl.load(T + 8),
        tl.load(T + 9),
        tl.load(T + 10),
    )


@triton.jit
def load_position(T):
    """The camera's centre of a pose."""
    return tl.load(T + 3), tl.load(T + 7), tl.load(T + 11)
