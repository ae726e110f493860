"""The surface pieces that rays meet: flat ones (rectangles, discs) as arrays, curved ones (cones, ellipsoids) one by
one.

Box faces and caps are flat patches. A rounded box is the union of its flat faces, edge cylinders and corner spheres, so
it becomes those patches, all textured through the box's own charts.
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
    """The side of a cone (``semi`` None) or an ellipsoid, in its own local frame."""

    R: ndarray
    t: ndarray
    extent: ndarray
    semi: ndarray | None
    half_height: float = 0.0
    rho0: float = 0.0
    """Cone radius at z = 0, metres."""
    slope: float = 0.0
    solid: Solid
    charts: ndarray
    """Chart number by face number of ``solid``; -1 where the face has no paint."""
    guard_normals: ndarray | None = None
    """The patch can be seen only from beyond one of these planes (rounded edges and corners). [k, 3]"""
    guard_offsets: ndarray | None = None

    def may_face(self, eye_W: ndarray) -> bool:
        """Whether the patch can be visible from ``eye_W``."""
        return self.guard_normals is None or bool((self.guard_normals @ eye_W > self.guard_offsets).any())

    def intersect(self, o: ndarray, d: Sequence[ndarray]) -> ndarray:
        """Nearest t > 0 with o + t d on the patch, local frame; inf if there is none."""
        if self.semi is not None:
            return _hit_ellipsoid(o / self.semi, [c / s for c, s in zip(d, self.semi, strict=True)])
        return _hit_cone(o, d, self.half_height, self.rho0, self.slope)

    def normal(self, p: ndarray) -> ndarray:
        """Outward unit normals at local points. [N, 3]"""
        if self.semi is not None:
            n = p / self.semi**2
        else:
            rho = np.maximum(np.hypot(p[..., 0], p[..., 1]), 1e-12)
            n = np.stack([p[..., 0] / rho, p[..., 1] / rho, np.full_like(rho, -self.slope)], -1)
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)


def _hit_ellipsoid(o: ndarray, d: Sequence[ndarray]) -> ndarray:
    """Unit sphere: |o + t d|^2 = 1, entering root."""
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    disc = b * b - a * (o @ o - 1)
    hit = disc > 0
    t = np.full(a.shape, np.inf)
    t[hit] = (-b[hit] - np.sqrt(disc[hit])) / a[hit]
    t[t <= 0] = np.inf
    return t


def _hit_cone(o: ndarray, d: Sequence[ndarray], half_height: float, rho0: float, slope: float) -> ndarray:
    """x^2 + y^2 = (rho0 + slope z)^2 with |z| <= half_height: the smaller valid root."""
    k = rho0 + slope * o[2]
    a = d[0] * d[0] + d[1] * d[1] - (slope * slope) * d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] - (slope * k) * d[2]
    disc = b * b - a * (o[0] * o[0] + o[1] * o[1] - k * k)
    t = np.full(a.shape, np.inf)
    hit = np.flatnonzero(disc > 0)
    a, b, dz, root = a.flat[hit], b.flat[hit], d[2].flat[hit], np.sqrt(disc.flat[hit])
    a = np.where(np.abs(a) < 1e-14, 1e-14, a)
    best = np.full(hit.shape, np.inf)
    for candidate in ((-b - root) / a, (-b + root) / a):
        z = o[2] + candidate * dz
        valid = (candidate > 0) & (np.abs(z) <= half_height) & (rho0 + slope * z >= 0)
        best = np.where(valid & (candidate < best), candidate, best)
    t.flat[hit] = best
    return t


def compile_patches(
    solids: Sequence[Solid], chart_of: dict[tuple[int, str], int]
) -> tuple[FlatPatches, list[CurvedPatch]]:
    """All visible surface pieces of ``solids``; ``chart_of[(solid number, face)]`` is the chart of a painted face."""
    flat: list[tuple] = []
    curved: list[CurvedPatch] = []
    for i, solid in enumerate(solids):
        charts = np.array([chart_of.get((i, face), -1) for face in solid.faces])
        if isinstance(solid, Box):
            flat += _box_faces(solid, charts)
            if solid.radius > 0:
                curved += _rounded_edges(solid, charts)
        elif isinstance(solid, Frustum):
            flat += _caps(solid, charts)
            if charts[0] >= 0:
                curved.append(_cone(solid, charts))
        elif isinstance(solid, Ellipsoid):
            curved.append(
                CurvedPatch(R=solid.R, t=solid.t, extent=solid.semi, semi=solid.semi, solid=solid, charts=charts)
            )
    columns = [np.array(c) for c in zip(*flat, strict=True)]
    names = ("centre", "right", "up", "normal", "half_w", "half_h", "disc", "chart", "chart_w", "chart_h")
    return FlatPatches(**dict(zip(names, columns, strict=True))), curved


def _box_faces(box: Box, charts: ndarray) -> list[tuple]:
    rows = []
    for face, chart in zip(box.faces, charts, strict=True):
        if chart < 0:
            continue
        right, up, normal = face_axes(face)
        half_w, half_h = np.abs(right) @ box.inner, np.abs(up) @ box.inner
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
        rows.append((centre, sign * R[:, 0], R[:, 1], sign * R[:, 2], r, r, True, chart, 2 * r, 2 * r))
    return rows


def _cone(f: Frustum, charts: ndarray) -> CurvedPatch:
    return CurvedPatch(
        R=f.R,
        t=f.t,
        extent=f.extent,
        semi=None,
        half_height=f.half_height,
        rho0=0.5 * (f.r_bottom + f.r_top),
        slope=f.slope,
        solid=f,
        charts=charts,
    )


def _rounded_edges(box: Box, charts: ndarray) -> list[CurvedPatch]:
    """Twelve edge cylinders and eight corner spheres; pieces between faces without paint are omitted."""
    pieces = []
    for signs in product((-1, 0, 1), repeat=3):
        s = np.array(signs)
        if np.count_nonzero(s) < 2:
            continue
        touched = [2 * axis + (sign > 0) for axis, sign in enumerate(s) if sign]
        if (charts[touched] < 0).all():
            continue
        normals = np.stack([box.R[:, axis] * s[axis] for axis in range(3) if s[axis]])
        offsets = normals @ box.t + box.inner[s != 0]
        R, extent, semi, half_height = box.R, np.full(3, box.radius), np.full(3, box.radius), 0.0
        if np.count_nonzero(s) == 2:
            axis = int(np.flatnonzero(s == 0)[0])
            R = box.R[:, [(axis + 1) % 3, (axis + 2) % 3, axis]]
            half_height, semi = float(box.inner[axis]), None
            extent = np.array([box.radius, box.radius, half_height])
        pieces.append(
            CurvedPatch(
                R=R,
                t=box.t + box.R @ (s * box.inner),
                extent=extent,
                semi=semi,
                half_height=half_height,
                rho0=box.radius,
                solid=box,
                charts=charts,
                guard_normals=normals,
                guard_offsets=offsets,
            )
        )
    return pieces
