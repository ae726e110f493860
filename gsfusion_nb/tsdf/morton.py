"""Morton codes: the coordinates of a block as one number, whose order keeps neighbours together."""

import functools

import torch
from jaxtyping import Int
from torch import Tensor

from ..backends import piece
from ..checks import check_shape
from ..errors import ArgumentError

BITS = 21
"""Bits per axis: 3 x 21 = 63 fit in a signed 64-bit integer."""

OFFSET = 1 << (BITS - 1)
"""Added to every coordinate, so that negative ones sort before positive ones."""

_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shift and mask pairs that move bit i of a 21-bit number to bit 3 i, halving the groups each
time."""

_PART = 7
"""Bits that ``interleave`` looks up at a time: 2^7 numbers, three times."""


def encode(coords: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Morton code of signed coordinates: bit i of x, y, z becomes bit 3i, 3i+1, 3i+2. The parent is
    ``code >> 3``.

    Args:
        coords: Integer coordinates, each in [-2^20, 2^20). [N, 3]

    Returns:
        Codes, int64, non-negative. [N]

    Raises:
        ValueError: a coordinate does not fit in 21 bits.

    Differentiable: no. Source: Morton 1966; GSFusion section III-A.
    """
    check_shape("coords", coords, ("N", 3))
    if coords.numel():
        check_range(*torch.stack(torch.aminmax(coords)).tolist())
    return interleave(coords)


def check_range(low: int, high: int) -> None:
    """Raise ``ValueError`` unless all coordinates from ``low`` to ``high`` have a code."""
    if low < -OFFSET or high >= OFFSET:
        raise ArgumentError(
            f"block coordinates must lie in [{-OFFSET}, {OFFSET}), got {low} to {high}"
        )


@piece
def interleave(coords: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """``encode`` without the check, for which the host would have to wait for a GPU."""
    bits_apart, first_bit, place = _tables(coords.device)
    positive = coords.to(torch.int64) + OFFSET
    parts = positive[:, :, None] >> first_bit & ((1 << _PART) - 1)
    return (bits_apart[parts] << place).sum((1, 2))


@functools.cache
def _tables(
    device: torch.device,
) -> tuple[Int[Tensor, " P"], Int[Tensor, " 3"], Int[Tensor, "3 3"]]:
    """Every part of a coordinate with two zeros between its bits; the first bit of the parts; their
    places in the code, by axis. The tables of a GPU are copied there once."""
    bits_apart = torch.arange(1 << _PART)
    for shift, mask in _SPREAD:
        bits_apart = (bits_apart | (bits_apart << shift)) & mask
    first_bit = torch.arange(0, BITS, _PART)
    place = torch.arange(3)[:, None] + 3 * first_bit
    return bits_apart.to(device), first_bit.to(device), place.to(device)


def decode(codes: Int[Tensor, " N"]) -> Int[Tensor, "N 3"]:
    """Coordinates of Morton codes, int64; the inverse of ``encode``. Differentiable: no."""
    every_third = _SPREAD[-1][1]
    bits = torch.stack([codes, codes >> 1, codes >> 2], dim=1) & every_third
    masks = [mask for _, mask in reversed(_SPREAD[:-1])] + [(1 << BITS) - 1]
    for (shift, _), mask in zip(reversed(_SPREAD), masks, strict=True):
        bits = (bits | (bits >> shift)) & mask
    return bits - OFFSET
