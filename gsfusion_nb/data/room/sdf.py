"""Signed distance to the solids of the room."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from .interior import SIZE_M, furnishing
from .solids import Solid

_CHUNK = 4096


def shell_distance(xyz_W: ndarray) -> ndarray:
    """Distance to the nearest of floor, walls and ceiling; negative outside the room. [N, 3] -> [N]"""
    half = 0.5 * np.array(SIZE_M)
    return (half - np.abs(xyz_W - [0.0, 0.0, half[2]])).min(-1)


def signed_distance(furnishing: Sequence[Solid], xyz_W: ndarray, owner: ndarray | None = None) -> ndarray:
    """Distance to the union of shell and ``furnishing``: the minimum over convex solids, exact in free space. [N]

    With ``owner`` [N], each point leaves out the solid of that number (-1: the shell).
    """
    out = np.empty(len(xyz_W))
    centres = np.array([s.t for s in furnishing])
    radii = np.array([np.linalg.norm(s.extent) for s in furnishing])
    for start in range(0, len(xyz_W), _CHUNK):
        part = slice(start, start + _CHUNK)
        xyz = xyz_W[part]
        best = shell_distance(xyz)
        if owner is not None:
            best[owner[part] == -1] = np.inf
        middle = 0.5 * (xyz.min(0) + xyz.max(0))
        spread = np.linalg.norm(xyz - middle, axis=1).max()
        lower = np.linalg.norm(centres - middle, axis=1) - radii - spread
        for i in np.argsort(lower):
            if lower[i] > best.max():
                break
            near = np.linalg.norm(xyz - centres[i], axis=1) - radii[i] < best
            if owner is not None:
                near &= owner[part] != i
            rows = np.flatnonzero(near)
            if rows.size:
                solid = furnishing[i]
                best[rows] = np.minimum(best[rows], solid.sdf(solid.to_local(xyz[rows])))
        out[part] = best
    return out


def room_sdf(xyz_W: Float[Tensor, "*N 3"], *, seed: int = 0) -> Float[Tensor, "*N"]:
    """Signed distance to the room's surfaces, metres: positive in free space, negative inside solids and outside.

    Exact in free space, because it is the minimum of exact distances to convex solids and to the shell; inside solids
    its magnitude is a lower bound on the distance to the surface of their union.

    Args:
        xyz_W: World points, metres (z up, origin on the floor in the middle). [*N, 3]
        seed: The room's seed.

    Returns:
        Signed distance, metres, in the dtype and on the device of ``xyz_W``. [*N]

    Differentiable: no.
    """
    points = xyz_W.detach().cpu().double().reshape(-1, 3).numpy()
    distance = torch.from_numpy(signed_distance(furnishing(seed), points))
    return distance.reshape(xyz_W.shape[:-1]).to(xyz_W.device, xyz_W.dtype)
