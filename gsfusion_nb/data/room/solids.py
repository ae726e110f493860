"""The convex solids the room is made of: shape, placement, exact signed distance, and the charts on
their faces.

The local frame of a solid is at its centre; a local point p is at ``R @ p + t`` in the world. A
face has a paint and chart coordinates (u to the right, v down, both 0..1, seen from outside with
local +z up), so that text is never mirrored.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

SIZE_M = (5.0, 4.0, 2.6)
"""Of the room."""

Colour = tuple[int | float, int | float, int | float]

Vector = Sequence[int | float] | ndarray

BOX_FACES = ("x-", "x+", "y-", "y+", "z-", "z+")


@dataclass(frozen=True, kw_only=True)
class Paint:
    """The surface of one face."""

    draw: Callable[[int, int, float, np.random.Generator], ndarray] | None = None
    """(width_px, height_px, texel_m, rng) -> uint8 [height_px, width_px, 3] albedo; None for the
    plain ``colour``."""
    colour: Colour = (0.8, 0.8, 0.8)
    """Albedo as an sRGB value, 0..1, if nothing is drawn."""
    texel_m: float = 0.03
    """Edge of a texel on the surface, metres."""
    glow: float = 0.0
    """Emitted brightness; > 0 replaces the shading."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """What all solids have.

    Each also has ``faces`` (their names), ``extent`` (half size of the local bounding box, metres
    [3]), ``sdf`` (signed distance of local points, metres, exact outside), ``face_size_m`` (width
    and height of a face's chart on the surface, metres), ``surface`` (local points and outward unit
    normals at chart coordinates) and ``chart`` (face number and chart coordinates of local points
    on curved faces). Cones and ellipsoids can be hit by rays.
    """

    t: ndarray
    """Centre, world frame, metres. [3]"""
    R: ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation, local to world. [3, 3]"""
    paints: Mapping[str, Paint]
    """Face name -> paint. A face without paint is never visible: it is neither drawn nor meshed."""
    occludes: bool = True
    """Whether it casts shadows (lamps do not)."""

    def to_local(self, xyz_W: ndarray) -> ndarray:
        """World points in the local frame."""
        return (xyz_W - self.t) @ self.R


@dataclass(frozen=True, kw_only=True, eq=False)
class Box(Placed):
    """A box with outer half size ``half`` whose edges are rounded with ``radius`` (0: sharp)."""

    half: ndarray
    radius: float = 0.0

    faces = BOX_FACES

    @property
    def extent(self) -> ndarray:
        return self.half

    @property
    def inner(self) -> ndarray:
        """Half size of the sharp core, which the rounding surrounds."""
        return self.half - self.radius

    def sdf(self, p: ndarray) -> ndarray:
        q = np.abs(p) - self.inner
        outer_m = np.sqrt((np.maximum(q, 0.0) ** 2).sum(-1))
        return outer_m + np.minimum(q.max(-1), 0.0) - self.radius

    def face_size_m(self, face: str) -> tuple[float, float]:
        right, up, _ = face_axes(face)
        return 2 * float(np.abs(right) @ self.half), 2 * float(np.abs(up) @ self.half)

    def surface(
        self,
        face: str,
        u: ndarray,
        v: ndarray,
    ) -> tuple[ndarray, ndarray]:
        right, up, normal = face_axes(face)
        a = (u - 0.5)[..., None] * right + (0.5 - v)[..., None] * up
        q = (2 * a + normal) * self.half
        if self.radius == 0:
            return q, np.broadcast_to(normal, q.shape).astype(float)
        core = np.clip(q, -self.inner, self.inner)
        e = q - core
        n = e / np.linalg.norm(e, axis=-1, keepdims=True)
        return core + self.radius * n, n

    def chart(self, p: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        core = np.clip(p, -self.inner, self.inner)
        e = p - core
        axis = np.abs(e).argmax(-1)
        main = np.take_along_axis(e, axis[..., None], -1)
        # The rounding is seen from its own core: moving e out to the sharp outer box gives the
        # point of the chart.
        q = core + e * (self.radius / np.maximum(np.abs(main), 1e-12))
        face = 2 * axis + (main[..., 0] > 0)
        right = _RIGHT[face]
        up = _UP[face]
        u = 0.5 + 0.5 * (right * q / self.half).sum(-1)
        v = 0.5 - 0.5 * (up * q / self.half).sum(-1)
        return face, u, v


@dataclass(frozen=True, kw_only=True, eq=False)
class Frustum(Placed):
    """A capped cone about local z, from radius ``r_bottom`` at -half_height to ``r_top`` at
    +half_height."""

    half_height: float
    r_bottom: float
    r_top: float

    faces = ("side", "bottom", "top")

    @property
    def slope(self) -> float:
        """Change of the radius per metre of height."""
        return (self.r_top - self.r_bottom) / (2 * self.half_height)

    @property
    def extent(self) -> ndarray:
        r = max(self.r_bottom, self.r_top)
        return np.array([r, r, self.half_height])

    def sdf(self, p: ndarray) -> ndarray:
        """Distance in the half plane (radius, height) to the profile's two caps and its slanted
        side."""
        rho = np.hypot(p[..., 0], p[..., 1])
        z = p[..., 2]
        h = self.half_height
        cap_radius = np.where(z < 0, self.r_bottom, self.r_top)
        cap_r = np.maximum(rho - cap_radius, 0.0)
        cap_z = np.abs(z) - h
        dr = self.r_top - self.r_bottom
        dz = 2 * h
        s = np.clip(
            ((rho - self.r_bottom) * dr + (z + h) * dz) / (dr * dr + dz * dz),
            0.0,
            1.0,
        )
        side_r = rho - self.r_bottom - s * dr
        side_z = z + h - s * dz
        d = np.sqrt(np.minimum(cap_r**2 + cap_z**2, side_r**2 + side_z**2))
        is_inside = (cap_z < 0) & (rho < self.r_bottom + (z + h) * self.slope)
        return np.where(is_inside, -d, d)

    def face_size_m(self, face: str) -> tuple[float, float]:
        if face == "side":
            slant = float(np.hypot(2 * self.half_height, self.r_top - self.r_bottom))
            return np.pi * (self.r_bottom + self.r_top), slant
        d = 2 * (self.r_bottom if face == "bottom" else self.r_top)
        return d, d

    def surface(
        self,
        face: str,
        u: ndarray,
        v: ndarray,
    ) -> tuple[ndarray, ndarray]:
        if face != "side":
            sign, r = (-1.0, self.r_bottom) if face == "bottom" else (1.0, self.r_top)
            x = 2 * u - 1
            y = 1 - 2 * v
            shrink = np.maximum(np.hypot(x, y), 1.0)  # the chart's corners lie outside the disc
            p = np.stack(
                [sign * r * x / shrink, r * y / shrink, np.full_like(x, sign * self.half_height)],
                -1,
            )
            return p, np.broadcast_to(np.array([0.0, 0.0, sign]), p.shape)
        angle = 2 * np.pi * u
        z = self.half_height * (1 - 2 * v)
        r = 0.5 * (self.r_bottom + self.r_top) + self.slope * z
        c = np.cos(angle)
        s = np.sin(angle)
        n = np.stack([c, s, np.full_like(c, -self.slope)], -1) / np.hypot(1.0, self.slope)
        return np.stack([r * c, r * s, z], -1), n

    def chart(self, p: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        u = np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi) % 1.0
        return np.zeros(u.shape, int), u, 0.5 - 0.5 * p[..., 2] / self.half_height

    def normal(self, p: ndarray) -> ndarray:
        """Outward unit normals at local points of the side. [N, 3]"""
        rho = np.maximum(np.hypot(p[..., 0], p[..., 1]), 1e-12)
        n = np.stack(
            [p[..., 0] / rho, p[..., 1] / rho, np.full_like(rho, -self.slope)],
            -1,
        )
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)

    def intersect(self, o: ndarray, d: Sequence[ndarray]) -> ndarray:
        """Nearest t > 0 with o + t d on the side, local frame; inf if there is none.

        x^2 + y^2 = (rho0 + slope z)^2 with |z| <= half_height: the smaller valid root.
        """
        rho0 = 0.5 * (self.r_bottom + self.r_top)
        slope = self.slope
        k = rho0 + slope * o[2]
        a = d[0] * d[0] + d[1] * d[1] - (slope * slope) * d[2] * d[2]
        b = o[0] * d[0] + o[1] * d[1] - (slope * k) * d[2]
        disc = b * b - a * (o[0] * o[0] + o[1] * o[1] - k * k)
        t = np.full(a.shape, np.inf)
        hit_rows = np.flatnonzero(disc > 0)
        a = a.flat[hit_rows]
        b = b.flat[hit_rows]
        dz = d[2].flat[hit_rows]
        root = np.sqrt(disc.flat[hit_rows])
        a = np.where(np.abs(a) < 1e-14, 1e-14, a)
        best = np.full(hit_rows.shape, np.inf)
        for candidate in ((-b - root) / a, (-b + root) / a):
            z = o[2] + candidate * dz
            valid = (candidate > 0) & (np.abs(z) <= self.half_height) & (rho0 + slope * z >= 0)
            best = np.where(valid & (candidate < best), candidate, best)
        t.flat[hit_rows] = best
        return t


@dataclass(frozen=True, kw_only=True, eq=False)
class Ellipsoid(Placed):
    """An ellipsoid with semi-axes ``semi``, metres; its chart is longitude and colatitude."""

    semi: ndarray

    faces = ("skin",)

    @property
    def extent(self) -> ndarray:
        return self.semi

    def sdf(self, p: ndarray) -> ndarray:
        """Distance to the nearest point x_i = e_i^2 y_i / (t + e_i^2); t solves sum (e_i y_i / (t +
        e_i^2))^2 = 1.

        Left of the root the function is convex and decreasing, so Newton's method started there
        never passes the root (Eberly, "Distance from a point to an ellipse, an ellipsoid", 2013).
        """
        e2 = self.semi**2
        y = np.abs(p)
        if np.ptp(self.semi) == 0:
            return np.linalg.norm(p, axis=-1) - self.semi[0]
        t = (self.semi * y - e2).max(-1)
        for _ in range(40):
            ratio = self.semi * y / np.maximum(t[..., None] + e2, 1e-12)
            g = (ratio**2).sum(-1) - 1
            slope = 2 * (ratio**2 / np.maximum(t[..., None] + e2, 1e-12)).sum(-1)
            step = g / np.maximum(slope, 1e-12)
            t = t + step
            if (np.abs(step) < 1e-12 + 1e-10 * np.abs(t)).all():
                break
        nearest = e2 * y / np.maximum(t[..., None] + e2, 1e-12)
        return np.sign(t) * np.linalg.norm(nearest - y, axis=-1)

    def face_size_m(self, face: str) -> tuple[float, float]:
        a, b, c = self.semi
        return np.pi * float(a + b), 0.5 * np.pi * float(max(a, b) + c)

    def surface(
        self,
        face: str,
        u: ndarray,
        v: ndarray,
    ) -> tuple[ndarray, ndarray]:
        lon = 2 * np.pi * u
        colat = np.pi * v
        unit = np.stack(
            [np.sin(colat) * np.cos(lon), np.sin(colat) * np.sin(lon), np.cos(colat)],
            -1,
        )
        n = unit / self.semi
        return unit * self.semi, n / np.linalg.norm(n, axis=-1, keepdims=True)

    def chart(self, p: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        q = p / self.semi
        u = np.arctan2(q[..., 1], q[..., 0]) / (2 * np.pi) % 1.0
        v = np.arccos(np.clip(q[..., 2], -1.0, 1.0)) / np.pi
        return np.zeros(u.shape, int), u, v

    def normal(self, p: ndarray) -> ndarray:
        """Outward unit normals at local points. [N, 3]"""
        n = p / self.semi**2
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)

    def intersect(self, o: ndarray, d: Sequence[ndarray]) -> ndarray:
        """Nearest t > 0 with o + t d on the surface, local frame; inf if there is none.

        Of the unit sphere |o + t d|^2 = 1 in units of the semi-axes, the entering root.
        """
        o = o / self.semi
        d = [c / s for c, s in zip(d, self.semi, strict=True)]
        a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
        disc = b * b - a * (o @ o - 1)
        is_hit = disc > 0
        t = np.full(a.shape, np.inf)
        t[is_hit] = (-b[is_hit] - np.sqrt(disc[is_hit])) / a[is_hit]
        t[t <= 0] = np.inf
        return t


Solid = Box | Frustum | Ellipsoid


def face_axes(face: str) -> tuple[ndarray, ndarray, ndarray]:
    """Right, up and outward normal of a box face, local frame: right = up x normal, as a viewer
    outside sees it."""
    i = BOX_FACES.index(face)
    return _RIGHT[i], _UP[i], _NORMAL[i]


_NORMAL = np.array(
    [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]],
    float,
)

_UP = np.array(
    [[0, 0, 1]] * 4 + [[0, 1, 0]] * 2,
    float,
)

_RIGHT = np.cross(_UP, _NORMAL)


def rotation(
    yaw_deg: int | float = 0.0, pitch_deg: int | float = 0.0, roll_deg: int | float = 0.0
) -> ndarray:
    """Rotation about z by yaw, then about the turned y by pitch, then about the turned x by roll.
    [3, 3]"""
    (cy, cp, cr), (sy, sp, sr) = (
        f(np.radians([yaw_deg, pitch_deg, roll_deg])) for f in (np.cos, np.sin)
    )
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return Rz @ Ry @ Rx
