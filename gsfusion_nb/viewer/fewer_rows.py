"""A large map with fewer Gaussians, for a page: neighbours of like colour become one."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry.quaternion import from_matrix, to_matrix
from ..geometry.spherical_harmonics import SH_C0
from ..geometry.voxel_keys import voxel_keys
from ..types import GaussianParams

_FINEST = 3.0
"""Edge of the smallest cells, in median sizes of a Gaussian."""
_LEVELS = 4
"""Each level has cells of twice the edge of the one before; at most so many are used, and only as
many as are needed, because large cells blur the borders of colours."""
_ALIKE = 0.05
"""Standard deviation of colours up to which they are alike: then no larger cells are tried."""
_TRIES = 12
"""Halvings of the interval of the colour's standard deviation in a cell up to which its Gaussians
become one."""
_FLAT = 0.12
"""They must lie in a layer whose thickness is at most this share of the cell's edge, except in the
smallest cells."""
_SPREAD = 4.5
"""Factor on the variance of the centres, so that neighbours overlap."""

_OPAQUE = math.log(0.97 / 0.03)
"""Logit of the opacity of one that stands for several, at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cells:
    """The Gaussians of a map in cells of one size: moments of each cell."""

    of_row: Int[Tensor, " N"]
    count: Float[Tensor, " M"]
    centre_W: Float[Tensor, "M 3"]
    spread_W: Float[Tensor, "M 3 3"]
    """Covariance of the centres."""
    sh: Float[Tensor, "M 3"]
    colour_std: Float[Tensor, " M"]
    flatness: Float[Tensor, " M"]
    """Thickness of the layer of centres, in edges of the cell."""


def merged(params: GaussianParams, most: int) -> tuple[GaussianParams, Int[Tensor, " M"]]:
    """A map of at most ``most`` Gaussians that looks like a larger one.

    Where Gaussians of like colour lie in a layer, those of a cell become one with their mean, their
    colour, and the covariance of them all; cells are larger where the colour changes less. If that
    is not enough, the most important ones are taken.

    Args:
        params: Finite rows on a processor. Higher harmonics are left out.
        most: Gaussians of the result.

    Returns:
        The smaller map, of degree 0, and for each of its rows one row of the map that it stands
        for.
    """
    flat = GaussianParams(**{**vars(params), "sh": params.sh[:, :1]})
    if len(params) <= most:
        return flat, torch.arange(len(params))
    size_m = float(params.log_scale.amax(1).exp().median())
    levels = [_cells_of(flat, _FINEST * size_m)]
    most_std = math.inf
    while most_std > _ALIKE and len(levels) < _LEVELS:
        levels.append(_cells_of(flat, _FINEST * size_m * 2 ** len(levels)))
        most_std = _smallest_std(levels, most)
    level_of_row = _level_of_rows(levels, most_std)
    parts = [
        _one_for_each(flat, cells, level_of_row == level) for level, cells in enumerate(levels)
    ]
    rows = torch.cat([rows for _, rows in parts])
    smaller = GaussianParams(
        **{name: torch.cat([vars(part)[name] for part, _ in parts]) for name in vars(flat)}
    )
    best = important_rows(smaller, most)
    return smaller[best], rows[best]


def important_rows(params: GaussianParams, most: int) -> Int[Tensor, " M"]:
    """Numbers of the Gaussians, in order; of more than ``most``, those with the largest opacity
    times area."""
    if len(params) <= most:
        return torch.arange(len(params))
    log_area = 2 * params.log_scale.sort(dim=1).values[:, 1:].mean(dim=1)
    weight = torch.nn.functional.logsigmoid(params.opacity_logit) + log_area
    return weight.topk(most).indices.sort().values


def _smallest_std(levels: list[_Cells], most: int) -> float:
    """The smallest spread of colours in a cell with which few enough Gaussians are left; 1 if there
    is none."""
    low = 0.0
    high = 1.0
    for _ in range(_TRIES):
        middle = (low + high) / 2
        is_small = _count(levels, _level_of_rows(levels, middle)) <= most
        low, high = (low, middle) if is_small else (middle, high)
    return high


def _level_of_rows(levels: list[_Cells], most_std: float) -> Int[Tensor, " N"]:
    """The level of the largest cell in which a Gaussian can be merged; 0 if there is none."""
    level_of_row = torch.zeros(len(levels[0].of_row), dtype=torch.int64)
    for level, cells in enumerate(levels[1:], start=1):
        is_alike = (cells.colour_std <= most_std) & (cells.flatness <= _FLAT)
        level_of_row[is_alike[cells.of_row]] = level
    return level_of_row


def _count(levels: list[_Cells], level_of_row: Int[Tensor, " N"]) -> int:
    """Gaussians that would be left."""
    total = 0
    for level, cells in enumerate(levels):
        has_rows = torch.zeros(len(cells.count), dtype=torch.bool)
        has_rows[cells.of_row[level_of_row == level]] = True
        total += int(has_rows.sum())
    return total


def _cells_of(params: GaussianParams, edge_m: float) -> _Cells:
    xyz = params.xyz_W.double()
    colour = params.sh[:, 0].double()
    keys = voxel_keys((xyz / edge_m).floor().long())
    _, of_row, counts = keys.unique(return_inverse=True, return_counts=True)
    n = len(counts)
    count = counts.double()

    def mean(values: Tensor) -> Tensor:
        sums = torch.zeros(n, *values.shape[1:], dtype=torch.float64).index_add_(0, of_row, values)
        return sums / count.view(-1, *[1] * (values.dim() - 1))

    centre = mean(xyz)
    mean_colour = mean(colour)
    offset = xyz - centre[of_row]
    spread = mean(offset[:, :, None] * offset[:, None, :])
    variance = mean((colour - mean_colour[of_row]).square())
    thickness = torch.linalg.eigvalsh(spread)[:, 0].clamp(min=0).sqrt()
    return _Cells(
        of_row=of_row,
        count=count.float(),
        centre_W=centre.float(),
        spread_W=spread.float(),
        sh=mean_colour.float(),
        colour_std=SH_C0 * variance.mean(1).sqrt().float(),
        flatness=(thickness / edge_m).float(),
    )


def _one_for_each(
    params: GaussianParams, cells: _Cells, is_member: Tensor
) -> tuple[GaussianParams, Int[Tensor, " M"]]:
    """One Gaussian for each cell that has members; a cell's only Gaussian stays as it is."""
    rows = is_member.nonzero().flatten()
    numbers, inverse = cells.of_row[rows].unique(return_inverse=True)
    first = torch.full((len(numbers),), len(params), dtype=torch.int64)
    first.scatter_reduce_(0, inverse, rows, "amin")
    one = params[first]
    several = (cells.count[numbers] > 1).nonzero().flatten()
    if not len(several):
        return one, first
    chosen = numbers[several]
    own = one[several]
    R = to_matrix(own.quat)
    own_W = R @ torch.diag_embed((2 * own.log_scale).exp()) @ R.mT
    values, axes = torch.linalg.eigh(own_W + _SPREAD * cells.spread_W[chosen])
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    columns = {name: column.clone() for name, column in vars(one).items()}
    columns["xyz_W"][several] = cells.centre_W[chosen]
    columns["log_scale"][several] = 0.5 * values.clamp(min=1e-12).log()
    columns["quat"][several] = from_matrix(axes)
    columns["sh"][several] = cells.sh[chosen][:, None]
    columns["opacity_logit"][several] = own.opacity_logit.clamp(min=_OPAQUE)
    return GaussianParams(**columns), first
