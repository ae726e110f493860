"""The linear octree that finds a voxel block by its coordinates."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from .morton import BITS, decode, encode, interleave

TABLE_CELLS = 1 << 23
"""Largest dense lookup table, cells (32 MB). A map whose bounding box is larger is searched by Morton code instead."""


class BlockIndex:
    """Sorted Morton codes of the allocated blocks, and the pool row of each.

    A linear octree (Gargantini 1982): only leaves are stored, the node above a code is ``code >> 3``, and all leaves
    below a node are neighbours in ``codes``. The world is limited only by the 21 bits per axis of a code. In a compact
    map blocks are found through a table over its bounding box, which is faster than a binary search.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self.codes: Int[Tensor, " B"] = torch.zeros(0, dtype=torch.int64, device=device)
        self.rows: Int[Tensor, " B"] = torch.zeros(0, dtype=torch.int64, device=device)
        self._table: Tensor | None = None
        self._low: Tensor = torch.zeros(3, dtype=torch.int64, device=device)
        self._size: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def of_blocks(cls, coords: Int[Tensor, "B 3"]) -> "BlockIndex":
        """The index of blocks whose row is their position in ``coords``, which must all be different."""
        index = cls(coords.device)
        index.codes, index.rows = encode(coords).sort()
        if len(index):
            index._update_table(coords, 0)
        return index

    def __len__(self) -> int:
        return self.codes.shape[0]

    def find(self, block_coords: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        """Pool row of each block, -1 where it is not allocated. int64"""
        if self._table is None:
            return self._search(encode(block_coords))
        cell, inside = self._cell(block_coords)
        rows = self._table.index_select(0, cell).to(torch.int64)
        return torch.where(inside, rows, -1)

    @property
    def table(self) -> tuple[Tensor, Tensor, tuple[int, int, int]] | None:
        """Dense lookup table, if there is one: rows (-1: none) of a box of blocks; its lowest block; its size."""
        return None if self._table is None else (self._table, self._low, self._size)

    def insert(self, coords: Int[Tensor, "N 3"], *, in_range: bool = False) -> Int[Tensor, " N"]:
        """Rows of the blocks at ``coords``; those not yet allocated get the next rows, in Morton order.

        Breadth-first allocation from the top (GSFusion III-B.1): a descent that creates the missing nodes level by
        level arrives at the new leaves in Morton order. Here the nodes above are implied by the leaf codes, so the
        whole descent is one merge of sorted codes; ``descend`` shows the levels.

        Args:
            coords: Integer coordinates of the blocks. [N, 3]
            in_range: The coordinates are known to fit in a code, so that the host need not wait for a GPU to check it.
        """
        codes = interleave(coords) if in_range else encode(coords)
        fresh = codes[self._search(codes) < 0].unique()
        if fresh.numel():
            n, new_rows = len(self), torch.arange(len(self), len(self) + len(fresh), device=fresh.device)
            at = torch.searchsorted(self.codes, fresh) + new_rows - n
            old_at = torch.searchsorted(fresh, self.codes) + torch.arange(n, device=fresh.device)
            self.codes = _merge(self.codes, old_at, fresh, at)
            self.rows = _merge(self.rows, old_at, new_rows, at)
            self._update_table(decode(fresh), n)
        return self._search(codes)

    def level(self, k: int) -> Int[Tensor, " P"]:
        """Codes of the distinct octree nodes ``k`` levels above the blocks; ``level(0)`` are the blocks. Sorted."""
        if not 0 <= k <= BITS:
            raise ValueError(f"level must be between 0 (blocks) and {BITS} (root), got {k}")
        return (self.codes >> (3 * k)).unique_consecutive()

    def descend(self, coords: Int[Tensor, "N 3"]) -> list[Int[Tensor, " P"]]:
        """The nodes that inserting ``coords`` would create, level by level from the root down to the blocks.

        Entry i holds the new codes ``21 - i`` levels above the blocks, so the last entry are the new blocks.
        """
        codes = encode(coords).unique()
        created = []
        for k in range(BITS, -1, -1):
            nodes = (codes >> (3 * k)).unique_consecutive()
            created.append(nodes[~torch.isin(nodes, self.level(k))])
        return created

    def _search(self, codes: Tensor) -> Tensor:
        if not len(self):
            return torch.full_like(codes, -1)
        at = torch.searchsorted(self.codes, codes).clamp(max=len(self) - 1)
        return torch.where(self.codes[at] == codes, self.rows[at], -1)

    def _cell(self, coords: Tensor) -> tuple[Int[Tensor, " N"], Bool[Tensor, " N"]]:
        nx, ny, nz = self._size
        x, y, z = (coords.to(torch.int64) - self._low).T.contiguous()  # contiguous planes are much faster on a CPU
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
        return ((x * ny + y) * nz + z) * inside, inside

    def _update_table(self, new_coords: Tensor, first_row: int) -> None:
        """Enter the new blocks, or make a larger table where the map has outgrown it."""
        if self._table is not None:
            cell, inside = self._cell(new_coords)
            if bool(inside.all()):
                self._table[cell] = torch.arange(first_row, len(self), dtype=torch.int32, device=cell.device)
                return
        coords = decode(self.codes)
        low, high = coords.amin(0), coords.amax(0)
        margin = (high - low) // 8 + 2
        self._low = low - margin
        nx, ny, nz = (int(s) for s in high - low + 2 * margin + 1)
        self._size = (nx, ny, nz)
        self._table = None
        if nx * ny * nz <= TABLE_CELLS:
            self._table = torch.full((nx * ny * nz,), -1, dtype=torch.int32, device=coords.device)
            self._table[self._cell(coords)[0]] = self.rows.to(torch.int32)


def _merge(old: Tensor, old_at: Tensor, new: Tensor, new_at: Tensor) -> Tensor:
    return old.new_empty(len(old) + len(new)).scatter_(0, old_at, old).scatter_(0, new_at, new)
