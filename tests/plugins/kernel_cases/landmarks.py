"""Least squares of landmarks for the pose of a camera.

Cases of ``landmark_sums`` and ``landmark_pose``: landmarks in front of and behind the camera, with
and without depth, some of them wrong, and none.
"""

import functools
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.landmark_pose import LandmarkRows, landmark_pose, landmark_sums

from . import Case, make_sighted_points

_ROUNDING = 1e-9


def cases() -> Iterator[Case]:
    """Few and many landmarks, and none."""
    for n in (0, 4, 300):
        run = functools.partial(_results, n)
        operations = ("landmark_sums", "landmark_pose")
        yield Case(
            name=f"{n} landmarks",
            operations=operations,
            run=run,
            dtypes=(torch.float32,),
            tolerance=_ROUNDING,
        )


def _results(
    n: int,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    camera, xyz_C, uv = make_sighted_points(n)
    inverse = torch.where(
        torch.arange(n) % 3 > 0,
        1 / xyz_C[:, 2].abs(),
        0.0,
    )
    T_WC = se3.exp(torch.tensor([0.4, -0.3, 0.2, 0.3, -0.8, 0.2]).double())
    rows = LandmarkRows(
        camera=camera,
        xyz_W=se3.apply(T_WC, xyz_C).numpy(),
        uv=uv.numpy(),
        inverse_depth=inverse.numpy(),
        sigma_px=1.0 + np.arange(n) % 3,
    )
    start = T_WC @ se3.exp(torch.tensor([0.02, 0.01, -0.02, 0.02, -0.01, 0.015]).double())
    results = {"pose": landmark_pose(rows, start)}
    for name, centre in (("origin", None), ("centre", torch.tensor([0.3, -0.2, 1.0]))):
        sums = landmark_sums(rows, start, centre)
        results |= {f"{name} {key}": torch.as_tensor(value) for key, value in vars(sums).items()}
    return results
