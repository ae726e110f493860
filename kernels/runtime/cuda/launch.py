"""Starting a kernel with torch tensors: which tensors are taken, what their arguments become, where
it runs."""

import ctypes
import functools
import os

import torch
from torch import Tensor

from gsfusion_nb.backends import BackendUnavailable

from . import driver, nvrtc
from .structs import signature

_EMULATOR = os.environ.get("GSFUSION_CUDA_EMULATOR", "")
_DIMENSION_LIMIT = 2**31 - 1


def _why_unavailable() -> str | None:
    """A sentence if the kernels cannot run here, else ``None``."""
    if _EMULATOR:
        return None
    if not torch.cuda.is_available():
        return "backend 'cuda' needs an NVIDIA GPU, and torch sees none"
    if torch.version.hip:
        return "backend 'cuda' needs an NVIDIA GPU, and this torch is built for AMD's"
    try:
        driver.library()
        nvrtc.library()
    except BackendUnavailable as e:
        return str(e)
    return None


# here and not in the package: every kernel imports this module, and is refused again
if _reason := _why_unavailable():
    raise BackendUnavailable(_reason)


def device_of(operation: str, tensor: Tensor) -> torch.device:
    """The device of a tensor; the check of the operation has seen that all others are there.

    Raises:
        BackendUnavailable: the kernels do not run there.
    """
    device = tensor.device
    if device.type != ("cpu" if _EMULATOR else "cuda"):
        raise BackendUnavailable(
            f"{operation}: backend 'cuda' takes CUDA tensors, got tensors on {device}"
        )
    return device


def launch(
    operation: str,
    source: str,
    grid: int | tuple[int, int],
    block: int,
    *args,
) -> None:
    """Run a kernel; an empty grid is allowed.

    Args:
        operation: Named by errors.
        source: "file:kernel" of ``<file>.cu``.
        grid: Blocks along x, or along x and y.
        block: Threads of a block.
        args: In the kernel's order: tensors for addresses (``None`` is the null pointer), numbers,
            and for a struct a dictionary with its fields.

    Raises:
        ValueError: a tensor has gaps, or a number is too large. RuntimeError: the driver refuses.
    """
    size = (grid, 1) if isinstance(grid, int) else grid
    if 0 in size:
        return
    if size[0] > _DIMENSION_LIMIT or size[1] > 65535:
        raise ValueError(f"{operation}: {size} blocks of work are more than a GPU takes at once")
    stem, kernel = source.split(":")
    parameters = signature(stem, kernel)
    values = parameters.flat(args)
    device = next(value.device for value in values if isinstance(value, Tensor))
    pointers, _kept = parameters.pack(operation, values)
    if device.type == "cpu":
        _emulate(operation, kernel, size, block, pointers)
    else:
        driver.start(operation, stem, kernel, size, block, device, pointers)


@functools.cache
def _emulator() -> ctypes.CDLL:
    return ctypes.CDLL(_EMULATOR)


def _emulate(
    operation: str,
    kernel: str,
    grid: tuple[int, int],
    block: int,
    pointers: ctypes.Array,
) -> None:
    run = getattr(_emulator(), f"emulate_{kernel}")
    run.restype = ctypes.c_char_p
    if problem := run(grid[0], grid[1], block, pointers):
        raise RuntimeError(f"{operation}: kernel {kernel}: {problem.decode()}")
