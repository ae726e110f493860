"""The rows of a map as viser draws them."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0
from ..types import GaussianParams
from ..viewer.fewer_rows import merged
from ..viewer.splat_rows import finite_rows

MOST_ROWS = 150_000
"""Of a map with more Gaussians some are shown, larger."""
_MOST_MERGED = 8
"""The final map is merged from at most so many times as many Gaussians."""
_OVERLAP = 1.4
"""Factor on the sizes of the Gaussians that are shown for others: they lie at random, and leave no
holes."""


def rows_to_show(params: GaussianParams) -> GaussianParams:
    """A copy on the processor, of about ``MOST_ROWS`` rows at most, without view-dependent colour.

    Of a larger map one row of k is shown, with sizes as if it stood for k. Which one looks random,
    because discs of a surface lie in a grid, in which every k-th one would be a stripe. A row that
    is shown stays so while k is the same.
    """
    k = -(-len(params) // MOST_ROWS) or 1
    if k == 1:
        return _copied(params, slice(None))
    shown = _mixed(torch.arange(len(params), device=params.xyz_W.device)) % k == 0
    thinned = _copied(params, shown)
    log_scale = thinned.log_scale + 0.5 * math.log(k) + math.log(_OVERLAP)
    return GaussianParams(**{**vars(thinned), "log_scale": log_scale})


def final_rows(params: GaussianParams) -> GaussianParams:
    """A copy on the processor, of at most ``MOST_ROWS`` rows, without view-dependent colour: of a
    larger map, neighbours of like colour become one, which takes seconds."""
    if len(params) <= MOST_ROWS:
        return rows_to_show(params)
    stride = max(1, len(params) // (_MOST_MERGED * MOST_ROWS))
    read = _copied(params, slice(None, None, stride))
    few, _ = merged(read[finite_rows(read)], MOST_ROWS)
    return few


def _copied(params: GaussianParams, rows: slice | Bool[Tensor, " N"]) -> GaussianParams:
    """Rows on the processor, without view-dependent colour."""
    columns = {name: column[rows] for name, column in vars(params).items()}
    columns["sh"] = columns["sh"][:, :1]
    return GaussianParams(
        **{name: column.detach().cpu().clone() for name, column in columns.items()}
    )


def _mixed(numbers: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Each number's own pseudo-random number, 0 to 2^31 (two rounds of shift and multiply)."""
    mixed = numbers.long()
    for _ in range(2):
        mixed = ((mixed >> 16) ^ mixed) * 0x45D9F3B & 0x7FFFFFFF
    return (mixed >> 16) ^ mixed


_RECORD = np.dtype(
    [
        ("xyz", "<f4", (3,)),
        ("covariance", "<f2", (3, 3)),
        ("rgb", "u1", (3,)),
        ("opacity", "u1", (1,)),
    ]
)


def records_of(params: GaussianParams) -> np.ndarray:
    """The rows as viser draws them; a row with a NaN or an infinity is transparent."""
    records = np.zeros(len(params), _RECORD)
    good = finite_rows(params)
    xyz, log_scale, quat = (
        torch.where(good[:, None], column, torch.ones(()))
        for column in (params.xyz_W, params.log_scale, params.quat)
    )
    axes = quaternion.to_matrix(quat) * log_scale.clamp(-7.0, 4.0).exp()[:, None, :]
    opacity = torch.where(good, params.opacity_logit.sigmoid(), torch.zeros(()))
    rgb = torch.where(good[:, None], params.sh[:, 0] * SH_C0 + 0.5, torch.zeros(()))
    records["xyz"] = xyz.numpy()
    records["covariance"] = (axes @ axes.mT).numpy()
    records["rgb"] = (255 * rgb.clamp(0, 1)).round().to(torch.uint8).numpy()
    records["opacity"] = (255 * opacity).round().to(torch.uint8)[:, None].numpy()
    return records
