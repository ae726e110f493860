"""Exercises of chapter 2: the voxel block that contains a point, and its Morton code."""

import torch
from torch import Tensor

from ..tsdf import morton
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _block_of(xyz_W: Tensor, voxel_size_m: float) -> Tensor:
    return (xyz_W / (8 * voxel_size_m)).floor().long()


def _block_of_truncated(xyz_W: Tensor, voxel_size_m: float) -> Tensor:
    return (xyz_W / (8 * voxel_size_m)).long()


def _block_of_rounded(xyz_W: Tensor, voxel_size_m: float) -> Tensor:
    return (xyz_W / (8 * voxel_size_m)).round().long()


def _voxel_of(xyz_W: Tensor, voxel_size_m: float) -> Tensor:
    return (xyz_W / voxel_size_m).floor().long()


def _as_block_of(yours: Yours, ijk: Tensor) -> Tensor:
    """Yours for the centres of voxels, in a grid whose voxels are 1 m."""
    voxels = ijk.reshape(-1, 3)
    return yours(
        voxels.double() + 0.5,
        1.0,
        gives={"the blocks": voxels},
    ).view_as(ijk)


@exercise(
    chapter=2,
    difficulty=1,
    minutes=5,
    solution=_block_of,
    becomes=Becomes("block_of", _as_block_of),
    hints=(
        "A block spans 8 voxels along each axis: its edge is 8 voxel sizes.",
        "Which whole number should -0.1 give? Compare int(-0.1) with math.floor(-0.1).",
    ),
    wrong=(
        Wrong(_block_of_truncated, says="below zero"),
        Wrong(_block_of_rounded, says="above zero, block k"),
        Wrong(_voxel_of, says="to 8 (k + 1) voxels"),
    ),
)
def block_of(attempt: Attempt) -> None:
    """The voxel block that contains a point."""
    block = attempt.on("(0.30, 0.05, 0.85) m with voxels of 5 cm")(
        torch.tensor([[0.30, 0.05, 0.85]]), 0.05
    )
    attempt.close(block, [[0, 0, 2]], "above zero, block k reaches from 8 k to 8 (k + 1) voxels")
    block = attempt.on("(-0.10, 0.10, -0.50) m with voxels of 5 cm")(
        torch.tensor([[-0.10, 0.10, -0.50]]), 0.05
    )
    attempt.close(
        block,
        [[-1, 0, -2]],
        "below zero too, a block reaches upwards from its lower corner",
        why="Rounding towards zero merges the two blocks beside the origin",
    )
    attempt.on("(0.39, 0.41, 2.37) and (-3.00, 0.02, 0.79) m with voxels of 5 cm")
    block = attempt(
        torch.tensor([[0.39, 0.41, 2.37], [-3.0, 0.02, 0.79]]),
        0.05,
    )
    attempt.close(
        block,
        [[0, 1, 5], [-8, 0, 1]],
        "a block has 8 voxels along each axis: its edge is 40 cm here",
    )
    block = attempt.on("(0.39, 0.41, 2.37) m with voxels of 2 cm")(
        torch.tensor([[0.39, 0.41, 2.37]]), 0.02
    )
    attempt.close(block, [[2, 2, 14]], "the edge of a block grows with voxel_size_m")


def _morton(x: int, y: int, z: int) -> int:
    code = 0
    for i in range(10):
        code |= (x >> i & 1) << 3 * i | (y >> i & 1) << 3 * i + 1 | (z >> i & 1) << 3 * i + 2
    return code


def _morton_one_after_the_other(x: int, y: int, z: int) -> int:
    return x | y << 10 | z << 20


def _morton_z_first(x: int, y: int, z: int) -> int:
    return _morton(z, y, x)


def _as_interleave(yours: Yours, coords: Tensor) -> Tensor:
    """The library's coordinates have 21 bits. Yours interleaves ten at a time: 30 bits of the
    code."""
    one = torch.zeros((), dtype=torch.int64)
    numbers: dict[tuple[int, ...], int] = {}

    def ten_bits(*xyz: int) -> int:
        if xyz not in numbers:
            numbers[xyz] = int(yours(*xyz, gives={"the code": one}))
        return numbers[xyz]

    rows = (coords.long() + morton.OFFSET).tolist()
    codes = [
        sum(ten_bits(*(c >> shift & 1023 for c in row)) << 3 * shift for shift in (0, 10, 20))
        for row in rows
    ]
    return torch.tensor(codes, dtype=torch.int64, device=coords.device)


@exercise(
    chapter=2,
    difficulty=3,
    minutes=15,
    solution=_morton,
    becomes=Becomes("interleave", _as_interleave),
    replaces=(morton.encode, morton.interleave),
    hints=(
        "Bit i of x is (x >> i) & 1. Where must it go?",
        "Bit i of x becomes bit 3 i, of y bit 3 i + 1, of z bit 3 i + 2; collect them with |.",
    ),
    wrong=(
        Wrong(_morton_one_after_the_other, says="then y: bit 0 of y is bit 1 of the code"),
        Wrong(_morton_z_first, says="x comes first"),
    ),
)
def morton_code(attempt: Attempt) -> None:
    """Interleave the bits of three block coordinates (0 to 1023)."""
    for coords, reference, prop in (
        ((1, 0, 0), 1, "x comes first: bit 0 of x is bit 0 of the code"),
        ((0, 1, 0), 2, "then y: bit 0 of y is bit 1 of the code"),
        ((0, 0, 1), 4, "then z: bit 0 of z is bit 2 of the code"),
        ((2, 0, 0), 8, "the bits alternate: bit 1 of x is bit 3 of the code"),
    ):
        attempt.close(attempt.on(f"block {coords}")(*coords), reference, prop)
    g = torch.Generator().manual_seed(0)
    for coords in torch.randint(0, 1024, (20, 3), generator=g).tolist():
        attempt.on(f"block {tuple(coords)}")
        code = int(attempt(*coords))
        parent = int(attempt(*(c // 2 for c in coords)))
        attempt.close(code >> 3, parent, "the parent's code is code >> 3")
        origin = int(morton.encode(torch.zeros(1, 3, dtype=torch.int64)))
        library = int(morton.encode(torch.tensor([coords]))) - origin
        attempt.close(
            code,
            library,
            "it agrees with gsfusion_nb.tsdf.morton.encode, minus the code of the origin",
        )
