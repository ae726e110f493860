"""The rows of a map as viser draws them."""

import math

import numpy as np
import torch

from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0
from ..types import GaussianParams
from ..viewer.splat_rows import finite_rows

MOST_ROWS = 150_000
"""Of a map with more Gaussians every second, third, ... is shown, larger."""


def rows_to_show(params: GaussianParams) -> GaussianParams:
    """A copy on the processor, of at most ``MOST_ROWS`` rows, without view-dependent colour."""
    stride = -(-len(params) // MOST_ROWS) or 1
    columns = {name: column[::stride] for name, column in vars(params).items()}
    columns["sh"] = columns["sh"][:, :1]
    columns["log_scale"] = columns["log_scale"] + 0.5 * math.log(stride)
    return GaussianParams(
        **{name: column.detach().cpu().clone() for name, column in columns.items()}
    )


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
