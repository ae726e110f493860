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


def signed_distance(
    furnishing: Sequence[Solid], xyz_W: ndarray, owner: ndarray | None = None, *, at_most: float = np.inf
) -> ndarray:
    """Distance to the union of shell and ``furnishing``: the minimum over convex solids, exact in free space. [N]

    With ``owner`` [N], each point leaves out the solid of that number (-1: the shell). Larger distances than
    ``at_most`` become ``at_most``; a small value saves looking at distant solids.
    """
    out = np.empty(len(xyz_W))
    centres = np.array([s.t for s in furnishing])
    boxes = np.array([np.abs(s.R) @ s.extent for s in furnishing])
    radii = np.array([np.linalg.norm(s.extent) for s in furnishing])
    for start in range(0, len(xyz_W), _CHUNK):
        part = slice(start, start + _CHUNK)
        xyz = xyz_W[part]
        best = shell_distance(xyz)
        if owner is not None:
            best[owner[part] == -1] = np.inf
        best = np.minimum(best, at_most)
        gap = np.maximum(xyz.min(0) - centres - boxes, centres - boxes - xyz.max(0)).max(1)
        lower = np.where(gap > 0, gap, -np.inf)  # a solid may be this close to the box around the points
        for i in np.argsort(lower):
            if lower[i] > best.max():
                break
            offset, reach = xyz - centres[i], (best + radii[i]).clip(min=0)
            near = np.einsum("nk,nk->n", offset, offset) < reach * reach
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
