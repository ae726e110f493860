"""Least squares of matched points for the relative pose of two views.

Cases of ``fit_pairs``: points in front of and behind the camera, with and without depth, some of them wrong.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.matching import PointPairs, fit_pairs

from ..runtime.cases import Case, make_sighted_points

_ROUNDING = 1e-9


def cases() -> Iterator[Case]:
    """Few and many pairs."""
    for n in (8, 300):

        def run(device: torch.device, dtype: torch.dtype, n: int = n) -> dict[str, Tensor]:
            return _results(n)

        yield Case(name=f"{n} pairs", operations=("fit_pairs",), run=run, dtypes=(torch.float32,), tolerance=_ROUNDING)


def _results(n: int) -> dict[str, Tensor]:
    camera, xyz_Q, uv = make_sighted_points(n)
    T_RQ = se3.exp(torch.tensor([0.2, -0.1, 0.1, 0.1, -0.3, 0.2]).double())
    depth_m = torch.where(torch.arange(n) % 3 > 0, xyz_Q[:, 2].abs() * 1.005, 0.0)
    sigma_px = 1.0 + torch.arange(n).double() % 3
    pairs = PointPairs(xyz_R=se3.apply(T_RQ, xyz_Q), uv=uv, depth_m=depth_m, sigma_px=sigma_px)
    start = T_RQ @ se3.exp(torch.tensor([0.02, 0.01, -0.02, 0.02, -0.01, 0.015]).double())
    T, information = fit_pairs(camera, pairs, start)
    return {"pose": T, "information": information}
