"""How Gaussians are turned, moved and scaled, with their view-dependent colours and Adam's
moments."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..geometry.spherical_harmonics import turned_harmonics
from ..types import GaussianParams


def turn_colours_(sh: Float[Tensor, "N K 3"], R: Float[Tensor, "N 3 3"]) -> None:
    """Turn the colours of each row with it, in place: seen from a direction that turned with it, it
    looks the same.

    Rows that moved with the same keyframes share a rotation, so there are far fewer rotations than
    rows.
    """
    if sh.shape[1] == 1:
        return
    for rows, turn in _each_turn(R):
        sh[rows] = turned_harmonics(sh[rows], turn)


def turn_moments_(mean: GaussianParams, square: GaussianParams, R: Float[Tensor, "N 3 3"]) -> None:
    """Turn Adam's running means of the gradients and of their squares with the rows, in place.

    The gradients of centre, quaternion and colour turn as these do. The mean square of  g' = M g
    is  (M o M) s  if the components of g are independent, with s their mean squares; for colours it
    is left as it is.
    """
    R = R.to(mean.xyz_W)
    q = quaternion.from_matrix(R)
    axes = torch.eye(4).to(q)
    L = torch.stack(
        [quaternion.multiply(q, axis.expand_as(q)) for axis in axes],
        -1,
    )  # q x = L x
    for moments, turns in ((mean, (R, L)), (square, (R * R, L * L))):
        for column, turn in zip((moments.xyz_W, moments.quat), turns, strict=True):
            column.copy_((turn @ column[:, :, None])[:, :, 0])
    turn_colours_(mean.sh, R)


def move_map_(model: Any, T: Float[Tensor, "N 4 4"]) -> None:
    """Apply a rigid motion to each row of a ``GaussianModel`` (a loop closure): centre,
    orientation, colour, and Adam's moments."""
    for prefix in ("", "anchor."):
        if f"{prefix}xyz_W" not in model.columns:
            continue
        xyz = model.columns[f"{prefix}xyz_W"]
        quat = model.columns[f"{prefix}quat"]
        turn = T.to(xyz)
        R = turn[:, :3, :3]
        xyz.copy_((R @ xyz[:, :, None]).squeeze(2) + turn[:, :3, 3])
        quat.copy_(quaternion.multiply(quaternion.from_matrix(R), quaternion.normalise(quat)))
    R = T[:, :3, :3].to(model.device)
    turn_colours_(model.params.sh, R)
    if "exp_avg.sh" in model.columns:
        turn_moments_(model.moments.exp_avg, model.moments.exp_avg_sq, R)


def _each_turn(R: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """The distinct rotations but the identity, each with its rows."""
    turns, which = torch.unique(
        R.reshape(-1, 9),
        dim=0,
        return_inverse=True,
    )
    order = which.argsort(stable=True)
    for turn, rows in zip(
        turns.view(-1, 3, 3),
        order.split(which.bincount(minlength=len(turns)).tolist()),
        strict=True,
    ):
        if not torch.equal(turn, torch.eye(3).to(turn)):
            yield rows, turn


def move_params(
    params: GaussianParams,
    R: Float[Tensor, "3 3"],
    t: Float[Tensor, "3"] | None = None,
    *,
    scale: float = 1.0,
) -> GaussianParams:
    """The map in another frame: x -> scale R x + t. It looks the same from a camera that is moved
    in the same way.

    Args:
        params: The map.
        R: Rotation matrix.
        t: Shift; none by default. [3]
        scale: Factor of all lengths, > 0.
    """
    R = R.detach().to(params.xyz_W.device, torch.float64)
    xyz = scale * (params.xyz_W.double() @ R.T)
    xyz = xyz if t is None else xyz + t.to(xyz)
    turn = quaternion.from_matrix(R)
    return GaussianParams(
        xyz_W=xyz.to(params.xyz_W),
        log_scale=params.log_scale + math.log(scale) if scale != 1.0 else params.log_scale,
        quat=quaternion.multiply(turn.expand(len(params), 4), params.quat.double()).to(params.quat),
        opacity_logit=params.opacity_logit,
        sh=turned_harmonics(params.sh, R),
    )
