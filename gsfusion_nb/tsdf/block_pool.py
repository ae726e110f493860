"""The memory of a volume: one row of values per voxel block, with spare rows for future blocks."""

import contextlib
import copy

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ..errors import MemoryFullError
from ..resources import MAP_MEMORY, available_memory

BLOCK_VOXELS = 8
"""Edge of a voxel block, voxels (Supereight2; GSFusion section III-A)."""

VOXELS_PER_BLOCK = BLOCK_VOXELS**3

BYTES_PER_BLOCK = VOXELS_PER_BLOCK * (4 + 4 + 12) + 12
"""Distance, weight and colour of every voxel as float32, and three int32 coordinates;
``W_RGB_BYTES`` more where colours have weights of their own. Colour is float32 because a running
mean at weight 100 changes by a hundredth of the difference: float16 would stop 6 grey levels away
from the mean and 8 bits 50 levels away. Integers with more bits would save memory, but converting
them takes too long."""

W_RGB_BYTES = VOXELS_PER_BLOCK * 4

BLOCKS_IN_BOX = 64
"""Rows for which it is known together where their blocks are. Neighbours in the pool were mostly
seen together."""

_FIRST_CAPACITY = 1024
_GROWTH = {"cpu": (8.0, 2.0, 1.25, 1.05), "cuda": (1.25, 1.05), "files": (2.0, 1.25)}
"""Factors of growth by kind of memory, the first that it allows. On a processor spare rows take no
memory before they are first written to. Large steps copy seldom and early, when there is little to
copy, so the volume can fill nearly all memory: doubling alone ends near half of it. The smallest
step keeps copies rare when memory is nearly full.
"""


class BlockPool:
    """The tensors behind a volume, with spare rows at the end. New rows are filled when they are
    handed out.

    Without ``weighs_colours`` there is no weight of the colours, ``W_rgb``.
    """

    def __init__(self, capacity: int, device: torch.device, *, weighs_colours: bool):
        self.capacity = capacity
        self.D, self.W = (
            MAP_MEMORY.rows(capacity, VOXELS_PER_BLOCK, device=device) for _ in range(2)
        )
        self.rgb = MAP_MEMORY.rows(capacity, 3, VOXELS_PER_BLOCK, device=device)
        self.W_rgb = (
            MAP_MEMORY.rows(capacity, VOXELS_PER_BLOCK, device=device) if weighs_colours else None
        )
        self.coords = MAP_MEMORY.rows(capacity, 3, dtype=torch.int32, device=device)
        self._boxes = np.empty((0, 2, 3), np.int32)

    def hand_out(self, first: int, coords: Int[Tensor, "M 3"]) -> None:
        """Fill the rows from ``first`` on as those of blocks that were never observed."""
        rows = slice(first, first + len(coords))
        self.D[rows] = 1.0
        self.W[rows] = 0.0
        self.rgb[rows] = 0.0
        if self.W_rgb is not None:
            self.W_rgb[rows] = 0.0
        self.coords[rows] = coords

    def stored(self, n_blocks: int) -> dict[str, Tensor]:
        """What a file holds of the first ``n_blocks`` rows; views."""
        weights = {} if self.W_rgb is None else {"W_rgb": self.W_rgb[:n_blocks]}
        return {
            "D": self.D[:n_blocks],
            "W": self.W[:n_blocks],
            "rgb": self.rgb[:n_blocks],
            "block_coords": self.coords[:n_blocks],
        } | weights

    def fill(self, stored: dict[str, Tensor]) -> None:
        """Write what ``stored`` gave into the first rows."""
        n = len(stored["block_coords"])
        rows = self.stored(n)
        for name, values in rows.items():
            values.copy_(stored[name])

    def boxes(self, n_blocks: int) -> Int[np.ndarray, "C 2 3"]:
        """Lowest and highest ``coords`` in each ``BLOCKS_IN_BOX`` of the first ``n_blocks`` rows,
        on a CPU."""
        boxes = self._boxes
        start = BLOCKS_IN_BOX * len(self._boxes)
        if start < n_blocks:
            coords = self.coords[start:n_blocks].numpy()
            first = np.arange(0, n_blocks - start, BLOCKS_IN_BOX)
            more = np.stack(
                [extreme.reduceat(coords, first) for extreme in (np.minimum, np.maximum)], 1
            )
            boxes = np.concatenate([boxes, more])
            self._boxes = boxes[: n_blocks // BLOCKS_IN_BOX]  # the last one may not be full
        return boxes

    def with_room_for(
        self, n_blocks: int, *, limit_bytes: int | None, voxel_size_m: float
    ) -> "BlockPool":
        """This pool, or a larger copy; it grows by a factor, so that the cost of copying stays
        constant per block.

        Args:
            n_blocks: Number of rows needed.
            limit_bytes: Largest size allowed; None: what the machine has available.
            voxel_size_m: Voxel size, metres, for the error message.

        Raises:
            MemoryError: The pool would be too large; it is unchanged.
        """
        if n_blocks <= self.capacity:
            return self
        device = self.D.device
        in_files = MAP_MEMORY.is_in_files(device)
        free = None if in_files else available_memory(device)
        factors = _GROWTH["files" if in_files else device.type]
        grown = [int(factor * max(n_blocks, _FIRST_CAPACITY)) for factor in factors]
        for capacity in (*grown, n_blocks):
            size = estimate_memory(capacity, weighs_colours=self.W_rgb is not None)
            if (limit_bytes is None or size <= limit_bytes) and (free is None or size <= free):
                # torch may get less than is free
                with contextlib.suppress(RuntimeError, MemoryError):
                    return self._grown(capacity)
        limits = [
            f"only {x / 1e6:.0f} MB may be used"
            for x in (limit_bytes, free)
            if x is not None and x < size
        ]
        n_bytes = estimate_memory(n_blocks, weighs_colours=self.W_rgb is not None)
        raise MemoryFullError(
            f"the TSDF volume needs {n_bytes / 1e6:.0f} MB for {n_blocks} blocks of 8^3 voxels of "
            f"{voxel_size_m} m, but {min(limits, default='the system grants less')}; "
            "use larger voxels (tsdf.voxel_size_m) or a smaller tsdf.far_m, or check the depth unit"
        )

    def _grown(self, capacity: int) -> "BlockPool":
        pool = copy.copy(self)
        pool.capacity = capacity
        for name, rows in vars(self).items():
            if isinstance(rows, Tensor):
                setattr(pool, name, MAP_MEMORY.extend(rows, capacity))
        return pool


def estimate_memory(n_blocks: int, *, weighs_colours: bool) -> int:
    """Memory of a volume of ``n_blocks`` blocks, bytes; more where colours have weights of their
    own."""
    return n_blocks * (BYTES_PER_BLOCK + (W_RGB_BYTES if weighs_colours else 0))
