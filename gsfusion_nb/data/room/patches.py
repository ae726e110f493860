"""The visible pieces of the surface of the room's solids: flat ones (rectangles, discs) as arrays,
curved ones (cones, ellipsoids) one by one.

Box faces and caps are flat patches. A rounded box is the union of its flat faces, edge cylinders
and corner spheres, so it becomes those patches, all textured through the box's own charts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy import ndarray

from .solids import Box, Ellipsoid, Frustum, Solid, face_axes


@dataclass(frozen=True, kw_only=True, eq=False)
class FlatPatches:
    """Rectangles (and discs inside them), one row each, world frame."""

    centre: ndarray
    right: ndarray
    up: ndarray
    normal: ndarray
    half_w: ndarray
    half_h: ndarray
    disc: ndarray
    """Whether only the inscribed disc belongs to the patch. [n] bool"""
    chart: ndarray
    """Chart number. [n]"""
    chart_w: ndarray
    """Width of the whole chart, metres; wider than the patch on a rounded box. [n]"""
    chart_h: ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class CurvedPatch:
    """The side of a cone, an ellipsoid, or a rounded edge or corner of a box."""

    shape: Frustum | Ellipsoid
    solid: Solid
    """Whose surface it is: ``shape`` itself, or the box."""
    charts: ndarray
    """Chart number by face number of ``solid``; -1 where the face has no paint."""
    guard_normals: ndarray | None = None
    """The patch can be seen only from beyond one of these planes (rounded edges and corners). [k,
    3]"""
    guard_offsets: ndarray | None = None

    def may_face(self, eye_W: ndarray) -> bool:
        """Whether the patch can be visible from ``eye_W``."""
        return self.guard_normals is None or bool(
            (self.guard_normals @ eye_W > self.guard_offsets).any()
        )


def compile_patches(
    solids: Sequence[Solid], chart_of: dict[tuple[int, str], int]
) -> tuple[FlatPatches, list[CurvedPatch]]:
    """All visible surface pieces of ``solids``; ``chart_of[(solid number, face)]`` is the chart of
    a painted face."""
    flat: list[tuple] = []
    curved_patches: list[CurvedPatch] = []
    for i, solid in enumerate(solids):
        charts = np.array([chart_of.get((i, face), -1) for face in solid.faces])
        if isinstance(solid, Box):
            flat += _box_faces(solid, charts)
            if solid.radius > 0:
                curved_patches += _rounded_edges(solid, charts)
        elif isinstance(solid, Frustum):
            flat += _caps(solid, charts)
            if charts[0] >= 0:
                curved_patches.append(CurvedPatch(shape=solid, solid=solid, charts=charts))
        else:
            curved_patches.append(CurvedPatch(shape=solid, solid=solid, charts=charts))
    columns = [np.array(c) for c in zip(*flat, strict=True)]
    names = (
        "centre",
        "right",
        "up",
        "normal",
        "half_w",
        "half_h",
        "disc",
        "chart",
        "chart_w",
        "chart_h",
    )
    return FlatPatches(**dict(zip(names, columns, strict=True))), curved_patches


def _box_faces(box: Box, charts: ndarray) -> list[tuple]:
    rows = []
    for face, chart in zip(box.faces, charts, strict=True):
        if chart < 0:
            continue
        right, up, normal = face_axes(face)
        half_w = np.abs(right) @ box.inner
        half_h = np.abs(up) @ box.inner
        centre = box.t + box.R @ (normal * box.half)
        axes = (box.R @ right, box.R @ up, box.R @ normal)
        rows.append((centre, *axes, half_w, half_h, False, chart, *box.face_size_m(face)))
    return rows


def _caps(frustum: Frustum, charts: ndarray) -> list[tuple]:
    rows = []
    for face, sign, r in (("bottom", -1.0, frustum.r_bottom), ("top", 1.0, frustum.r_top)):
        chart = charts[frustum.faces.index(face)]
        if chart < 0 or r == 0:
            continue
        R = frustum.R
        centre = frustum.t + R[:, 2] * (sign * frustum.half_height)
        rows.append(
            (centre, sign * R[:, 0], R[:, 1], sign * R[:, 2], r, r, True, chart, 2 * r, 2 * r)
        )
    return rows


def _rounded_edges(box: Box, charts: ndarray) -> list[CurvedPatch]:
    """Twelve edge cylinders and eight corner spheres; pieces between faces without paint are
    omitted."""
    pieces = []
    for signs in product((-1, 0, 1), repeat=3):
        s = np.array(signs)
        if np.count_nonzero(s) < 2:
            continue
        faces_there = [2 * axis + (sign > 0) for axis, sign in enumerate(s) if sign]
        if (charts[faces_there] < 0).all():
            continue
        normals = np.stack([box.R[:, axis] * s[axis] for axis in range(3) if s[axis]])
        offsets = normals @ box.t + box.inner[s != 0]
        t = box.t + box.R @ (s * box.inner)
        r = box.radius
        shape: Frustum | Ellipsoid = Ellipsoid(
            t=t,
            R=box.R,
            paints={},
            semi=np.full(3, r),
        )
        if np.count_nonzero(s) == 2:
            axis = int(np.flatnonzero(s == 0)[0])
            R = box.R[:, [(axis + 1) % 3, (axis + 2) % 3, axis]]
            shape = Frustum(
                t=t,
                R=R,
                paints={},
                half_height=float(box.inner[axis]),
                r_bottom=r,
                r_top=r,
            )
        pieces.append(
            CurvedPatch(
                shape=shape, solid=box, charts=charts, guard_normals=normals, guard_offsets=offsets
            )
        )
    return pieces
