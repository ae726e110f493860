"""The linear octree that finds a voxel block by its coordinates.

Its keys are Morton codes: three block coordinates interleaved bit by bit. Sorted codes visit the
blocks in octree order.
"""

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..errors import ArgumentError
from .morton import BITS, OFFSET, check_range, encode, interleave

log = logging.getLogger(__name__)

Corner = tuple[int, int, int]

NODE_BITS = 4
"""A node of the table is 2^4 blocks wide."""

TABLE_NODES = 1 << 24
"""Largest box of nodes in a table (64 MB): a cube of 327 m with voxels of 1 cm. A larger map is
searched by code."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NewBlocks:
    """Blocks that are not allocated yet, each once, in Morton order."""

    coords: Int[Tensor, "M 3"]
    """Integer coordinates. int64"""
    codes: Int[Tensor, " M"]
    """Their Morton codes."""
    low: Corner
    """A box around all of them: its lowest block."""
    high: Corner
    """Its highest block."""

    def __len__(self) -> int:
        return self.codes.shape[0]

    def contains(self, block_coords: Int[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Whether each block is one of them."""
        return _among(interleave(block_coords.clamp(-OFFSET, OFFSET - 1)), self.codes)


class BlockTable:
    """Pool rows of blocks by their coordinates, in two levels: a box of nodes, and a row for each
    block of a node.

    The nodes are those of the octree four levels above the blocks. Only nodes with blocks have
    rows, so that a long walk or one far block costs little memory. Node 0 has no blocks; it stands
    for all nodes that do not exist.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self.low: Corner = (0, 0, 0)
        """Lowest node of the box."""
        self.nodes = torch.zeros(1, 1, 1, dtype=torch.int32, device=device)
        """Number of each node of the box. [X, Y, Z]"""
        self.rows = torch.full(
            (1, 1 << 3 * NODE_BITS),
            -1,
            dtype=torch.int32,
            device=device,
        )
        """Pool row of each block of a node (number 256 x + 16 y + z), -1: none; spare ones at the
        end. [N, 4096]"""
        self._count = torch.zeros((), dtype=torch.int64, device=device)
        self._most = 0  # the count or more: the host does not wait for a GPU to know it

    def find(self, block_coords: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        """Pool row of each block, -1 where it is not allocated. int64"""
        cell, number, in_grid = self._place(block_coords)
        node = self.nodes.view(-1).index_select(0, cell) * in_grid
        return self.rows.view(-1).index_select(0, (node.long() << 3 * NODE_BITS) + number).long()

    def enter(self, new: NewBlocks, rows: Int[Tensor, " M"]) -> bool:
        """Enter blocks with their pool rows; False if the box of nodes would be too large."""
        low, high = (_corner(x >> NODE_BITS for x in corner) for corner in (new.low, new.high))
        if not self._enclose(low, high):
            return False
        self._make_room(
            min(
                len(new),
                math.prod(b - a + 1 for a, b in zip(low, high, strict=True)),
            )
        )
        cell, number, _ = self._place(new.coords)
        node = self.nodes.view(-1)[cell].long()
        parent = new.codes >> 3 * NODE_BITS
        # blocks of a node are neighbours in Morton order
        first = parent.diff(prepend=parent.new_full((1,), -1)) != 0
        n_new = (first & (node == 0)).cumsum(0)
        node = torch.where(node == 0, self._count + n_new, node)
        self._count = self._count + n_new[-1]
        self.nodes.view(-1)[cell] = node.int()
        self.rows[node, number] = rows.int()
        return True

    def _place(
        self,
        coords: Int[Tensor, "N 3"],
    ) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Bool[Tensor, " N"]]:
        """Cell of each block's node in the box, the block's number in the node, and whether the
        node is in the box."""
        nx, ny, nz = self.nodes.shape
        x, y, z = coords.long().T.contiguous()  # contiguous planes are much faster on a CPU
        i = (x >> NODE_BITS) - self.low[0]
        j = (y >> NODE_BITS) - self.low[1]
        k = (z >> NODE_BITS) - self.low[2]
        in_grid = (i >= 0) & (i < nx)
        in_grid = in_grid & (j >= 0) & (j < ny)
        in_grid = in_grid & (k >= 0) & (k < nz)
        cell = ((i * ny + j) * nz + k) * in_grid

        in_node = (1 << NODE_BITS) - 1
        x = x & in_node
        y = y & in_node
        z = z & in_node
        number = (((x << NODE_BITS) + y) << NODE_BITS) + z
        return cell, number, in_grid

    def _enclose(self, low: Corner, high: Corner) -> bool:
        """Enlarge the box, with room for more, so that it holds these nodes; False if it would be
        too large."""
        if not self._most:
            self.low = low
        first = np.array(self.low)
        end = first + self.nodes.shape
        if np.all(first <= low) and np.all(np.array(high) < end):
            return True
        new_first = np.minimum(low, first)
        new_end = np.maximum(np.array(high) + 1, end)
        margin = (new_end - new_first) // 8 + 1
        new_first = new_first - margin
        size = (new_end + margin - new_first).tolist()
        if math.prod(size) > TABLE_NODES:
            return False

        nodes = self.nodes.new_zeros(size)
        x, y, z = (slice(a, b) for a, b in zip(first - new_first, end - new_first, strict=True))
        nodes[x, y, z] = self.nodes
        self.low = _corner(new_first.tolist())
        self.nodes = nodes
        return True

    def _make_room(self, n_nodes: int) -> None:
        """Make sure that so many more nodes have rows; the host waits for a GPU only where they
        might not."""
        self._most += n_nodes
        if self._most >= len(self.rows):
            self._most = int(self._count) + n_nodes
        if self._most >= len(self.rows):
            n_spare = 2 * self._most + 1 - len(self.rows)
            spare = self.rows.new_full((n_spare, self.rows.shape[1]), -1)
            self.rows = torch.cat([self.rows, spare])


class BlockIndex:
    """Sorted Morton codes of the allocated blocks, and the pool row of each.

    A linear octree (Gargantini 1982): only leaves are stored, the node above a code is
    ``code >> 3``, and all leaves below a node are neighbours in ``codes``. The world is limited
    only by the 21 bits per axis of a code. Blocks are found through a table, which is faster than a
    binary search.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self._codes: Int[Tensor, " B"] = torch.zeros(0, dtype=torch.int64, device=device)
        self._rows: Int[Tensor, " B"] = torch.zeros(0, dtype=torch.int64, device=device)
        self._added: list[Tensor] = []
        self._count = 0
        self.table: BlockTable | None = BlockTable(device)
        """None where the map has outgrown it."""

    @classmethod
    def of_blocks(cls, coords: Int[Tensor, "B 3"]) -> "BlockIndex":
        """The index of blocks whose row is their position in ``coords``, which must all be
        different."""
        index = cls(coords.device)
        index._codes, index._rows = encode(coords).sort()
        index._count = len(coords)
        if len(index):
            low, high = torch.stack(torch.aminmax(coords, dim=0)).tolist()
            coords = coords[index._rows].long()
            blocks = NewBlocks(
                coords=coords, codes=index._codes, low=_corner(low), high=_corner(high)
            )
            index._enter(blocks, index._rows)
        return index

    def __len__(self) -> int:
        return self._count

    @property
    def codes(self) -> Int[Tensor, " B"]:
        """Morton codes of the blocks, sorted."""
        self._merge_added()
        return self._codes

    @property
    def rows(self) -> Int[Tensor, " B"]:
        """Pool row of each of them."""
        self._merge_added()
        return self._rows

    def find(self, block_coords: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        """Pool row of each block, -1 where it is not allocated. int64"""
        return (
            self._search(encode(block_coords))
            if self.table is None
            else self.table.find(block_coords)
        )

    def missing(self, coords: Int[Tensor, "N 3"]) -> NewBlocks:
        """Those of the blocks at ``coords`` that are not allocated. The host waits for a GPU once.

        Raises:
            ValueError: a coordinate does not fit in a Morton code.
        """
        coords = coords.to(torch.int64)
        # a GPU would be waited for here
        by_table = self.table is not None and coords.device.type == "cpu"
        if by_table:
            coords = coords[self.find(coords) < 0]
        if not len(coords):
            return NewBlocks(
                coords=coords,
                codes=coords.new_zeros(0),
                low=(0, 0, 0),
                high=(0, 0, 0),
            )
        codes = interleave(coords)
        present = (
            torch.zeros_like(codes, dtype=torch.bool) if by_table else _among(codes, self.codes)
        )
        codes, order = codes.masked_fill(present, -1).sort()  # those that exist come first, as -1
        counts = torch.stack([present.sum(), (codes.diff() == 0).sum()])
        *box, n, equal = torch.cat([*torch.aminmax(coords, dim=0), counts]).tolist()
        check_range(min(box), max(box))
        codes = codes[n:]
        order = order[n:]
        if equal > max(n - 1, 0):  # a block was given twice
            first = codes.diff(prepend=codes.new_full((1,), -1)) != 0
            codes = codes[first]
            order = order[first]
        return NewBlocks(
            coords=coords[order],
            codes=codes,
            low=_corner(box[:3]),
            high=_corner(box[3:]),
        )

    def add(self, new: NewBlocks) -> None:
        """Give the next rows to the blocks that ``missing`` returned, in their order.

        Breadth-first allocation from the top (GSFusion III-B.1): a descent that creates the missing
        nodes level by level arrives at the new leaves in Morton order. Here the nodes above are
        implied by the leaf codes, so the whole descent is one merge of sorted codes. The merge is
        left until the codes are asked for: where blocks are found through the table, that is not in
        every frame.
        """
        n = len(self)
        M = len(new)
        if not M:
            return
        self._added.append(new.codes)
        self._count += M
        self._enter(new, torch.arange(n, n + M, device=new.codes.device))

    def _merge_added(self) -> None:
        if not self._added:
            return
        fresh = torch.cat(self._added)
        n = len(self._codes)
        rows = torch.arange(n, n + len(fresh), device=fresh.device)
        if len(self._added) > 1:
            fresh, order = fresh.sort()
            rows = rows[order]
        places = torch.arange(n + len(fresh), device=fresh.device)
        at = torch.searchsorted(self._codes, fresh) + places[: len(fresh)]
        old_at = torch.searchsorted(fresh, self._codes) + places[:n]
        self._codes = _merge(self._codes, old_at, fresh, at)
        self._rows = _merge(self._rows, old_at, rows, at)
        self._added = []

    def level(self, k: int) -> Int[Tensor, " P"]:
        """Codes of the distinct octree nodes ``k`` levels above the blocks; ``level(0)`` are the
        blocks. Sorted."""
        if not 0 <= k <= BITS:
            raise ArgumentError(f"level must be between 0 (blocks) and {BITS} (root), got {k}")
        return (self.codes >> (3 * k)).unique_consecutive()

    def _search(self, codes: Tensor) -> Tensor:
        if not len(self):
            return torch.full_like(codes, -1)
        at = torch.searchsorted(self.codes, codes).clamp(max=len(self) - 1)
        return torch.where(self.codes[at] == codes, self.rows[at], -1)

    def _enter(self, new: NewBlocks, rows: Int[Tensor, " M"]) -> None:
        """Enter new blocks into the table while the map has one."""
        if self.table is not None and not self.table.enter(new, rows):
            self.table = None
            log.warning(
                "blocks from %s to %s: the map is too large for a table of its blocks, and looking "
                "at it is slow from "
                "here on; check the poses, or use larger voxels (tsdf.voxel_size_m)",
                new.low,
                new.high,
            )


def _corner(numbers: Iterable[int]) -> Corner:
    x, y, z = numbers
    return x, y, z


def _among(codes: Tensor, sorted_codes: Tensor) -> Bool[Tensor, " N"]:
    """Whether each code is one of ``sorted_codes``."""
    if not len(sorted_codes):
        return torch.zeros_like(codes, dtype=torch.bool)
    at = torch.searchsorted(sorted_codes, codes).clamp(max=len(sorted_codes) - 1)
    return sorted_codes[at] == codes


def _merge(old: Tensor, old_at: Tensor, new: Tensor, new_at: Tensor) -> Tensor:
    return old.new_empty(len(old) + len(new)).scatter_(0, old_at, old).scatter_(0, new_at, new)
