"""Signed distance to the room's surfaces."""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from .solids import SIZE_M, Solid

_POINTS_AT_ONCE = 4096


def shell_distance(xyz_W: ndarray) -> ndarray:
    """Distance to the nearest of floor, walls and ceiling; negative outside the room. [N, 3] ->
    [N]"""
    half = 0.5 * np.array(SIZE_M)
    return (half - np.abs(xyz_W - [0.0, 0.0, half[2]])).min(-1)


def signed_distance(
    furnishing: Sequence[Solid],
    xyz_W: ndarray,
    owner: ndarray | None = None,
    *,
    at_most: float = np.inf,
) -> ndarray:
    """Distance to the union of shell and ``furnishing``: the minimum over convex solids, exact in
    free space. [N]

    With ``owner`` [N], each point leaves out the solid of that number (-1: the shell). Larger
    distances than ``at_most`` become ``at_most``; a small value saves looking at distant solids.
    """
    distance_m = np.empty(len(xyz_W))
    centres = np.array([s.t for s in furnishing])
    boxes = np.array([np.abs(s.R) @ s.extent for s in furnishing])
    radii = np.array([np.linalg.norm(s.extent) for s in furnishing])
    for start in range(0, len(xyz_W), _POINTS_AT_ONCE):
        part = slice(start, start + _POINTS_AT_ONCE)
        xyz = xyz_W[part]
        best = shell_distance(xyz)
        if owner is not None:
            best[owner[part] == -1] = np.inf
        best = np.minimum(best, at_most)
        gap = np.maximum(xyz.min(0) - centres - boxes, centres - boxes - xyz.max(0)).max(1)
        # a solid may be this close to the box around the points
        lower = np.where(gap > 0, gap, -np.inf)
        for i in np.argsort(lower):
            if lower[i] > best.max():
                break
            offset = xyz - centres[i]
            reach = (best + radii[i]).clip(min=0)
            is_near = np.einsum("nk,nk->n", offset, offset) < reach * reach
            if owner is not None:
                is_near &= owner[part] != i
            rows = np.flatnonzero(is_near)
            if rows.size:
                solid = furnishing[i]
                best[rows] = np.minimum(best[rows], solid.sdf(solid.to_local(xyz[rows])))
        distance_m[part] = best
    return distance_m
