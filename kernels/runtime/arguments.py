"""Arguments of kernels: tensors as the arrays that a kernel reads, checked and packed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.tsdf import octree
from gsfusion_nb.types import Camera

_ALIGNMENT = 16
"""Bytes: rows are read four numbers at a time."""


def check_dtype(operation: str, dtype: torch.dtype, **tensors: Tensor | None) -> None:
    """Raise ``ValueError`` unless all ``tensors`` hold numbers of type ``dtype``."""
    for name, value in tensors.items():
        if value is not None and value.dtype != dtype:
            raise ValueError(f"{operation}: {name} must be {dtype}, got {value.dtype}")


def packed(tensor: Tensor) -> Tensor:
    """The same values without gaps, from an address that is a multiple of 16 bytes; a copy only
    where needed."""
    tensor = tensor.detach().contiguous()
    return tensor if tensor.data_ptr() % _ALIGNMENT == 0 else tensor.clone()


def as_bytes(mask: Tensor | None) -> Tensor | None:
    """A boolean mask as uint8, which kernels read; ``None`` stays."""
    return None if mask is None else packed(mask).view(torch.uint8)


def parts(count: int, size: int) -> int:
    """Blocks of threads, or programs, needed for ``count`` items, ``size`` in each."""
    return -(-count // size)


NODE_BITS = octree.NODE_BITS
IN_NODE = (1 << NODE_BITS) - 1
"""Of a block's coordinate, those bits that tell its place in its node."""
NODE_SHIFT = NODE_BITS + 3
"""Bits of a voxel's coordinate within its node."""


class BlockTable(NamedTuple):
    """The arrays of ``gsfusion_nb.tsdf.octree.BlockTable``, int32."""

    nodes: np.ndarray
    """Number of each node of the box, z fastest."""
    rows: np.ndarray
    """Row in the pool of each block of each node, -1 where there is none."""
    low: np.ndarray
    """Lowest node of the box. [3]"""
    size: np.ndarray
    """Nodes along each axis. [3]"""

    @staticmethod
    def of(table: octree.BlockTable) -> "BlockTable":
        """Those of a table on the processor."""
        low = np.array(table.low, np.int32)
        size = np.array(table.nodes.shape, np.int32)
        return BlockTable(
            nodes=table.nodes.view(-1).numpy(), rows=table.rows.view(-1).numpy(), low=low, size=size
        )


class Lens(NamedTuple):
    """Focal lengths and principal point, pixels."""

    fx: Any
    fy: Any
    cx: Any
    cy: Any


def lens_of(camera: Camera, number: Callable[[float], Any] = float) -> Lens:
    """Those of ``camera``, each as a ``number``: its precision in the kernel."""
    return Lens(
        fx=number(camera.fx), fy=number(camera.fy), cx=number(camera.cx), cy=number(camera.cy)
    )


def ray_slopes(camera: Camera) -> tuple[Tensor, Tensor]:
    """x / z of every column [W] and y / z of every row [H] of pixels, float32."""
    x = (torch.arange(camera.width, dtype=torch.float32) + (0.5 - camera.cx)) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float32) + (0.5 - camera.cy)) / camera.fy
    return x, y
