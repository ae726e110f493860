"""Light that is baked into the room: lamps with soft shadows, daylight from the window, and ambient
light that is darker near contacts.

Shadows and ambient occlusion are cones traced through a coarse distance grid: the narrowest
clearance along a cone, relative to its width, is the share of it that is free. The result is
smooth, as light from large sources is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from .distance import shell_distance
from .solids import SIZE_M, Solid

_VOXEL_M = 0.03

_REACH_M = 0.3
"""Largest distance stored in the grid, metres."""

_LIFT_M = 0.03
"""Distance from the surface at which cones start, so that it casts no shadow on itself, metres."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A large light source: a ball of ``radius_m`` that is brightest along ``axis``."""

    position: tuple[float, float, float]
    radius_m: float
    colour: tuple[float, float, float]
    """Irradiance at a distance of 1 m, linear."""
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)
    backward: float = 1.0
    """Brightness opposite to the axis relative to that along it; 1 is the same in all
    directions."""


LIGHTS = (
    Light(
        position=(1.5, 0.35, 1.93),
        radius_m=0.16,
        colour=(1.55, 1.32, 1.02),
        backward=0.12,
    ),
    Light(
        position=(-2.1, 1.62, 1.47),
        radius_m=0.16,
        colour=(0.62, 0.48, 0.31),
        backward=1.0,
    ),
    *(
        Light(
            position=(x, 1.86, z),
            radius_m=0.3,
            colour=(0.93, 1.03, 1.14),
            axis=(0.0, -1.0, -0.25),
            backward=0.0,
        )
        for x in (-0.25, 0.65)
        for z in (1.3, 1.85)
    ),
)

_AMBIENT_UP = np.array([0.30, 0.30, 0.31])
"""For surfaces that face up: light from ceiling and upper walls."""

_AMBIENT_DOWN = np.array([0.44, 0.40, 0.36])
"""For surfaces that face down: light from the wooden floor."""


class DistanceGrid:
    """Distance to the furnishing on a coarse grid over the room, at most ``_REACH_M``."""

    def __init__(self, solids: Sequence[Solid]):
        half = 0.5 * np.array([*SIZE_M[:2], 0.0])
        self.origin = -half - 0.1 * np.array([1, 1, 1])
        self.shape = np.ceil((np.array(SIZE_M) + 0.2) / _VOXEL_M).astype(int) + 1
        self.values = np.full(self.shape, _REACH_M, np.float32)
        for solid in solids:
            if solid.occludes:
                self._include(solid)

    def _include(self, solid: Solid) -> None:
        reach = np.abs(solid.R) @ solid.extent + _REACH_M
        low = np.clip(
            np.floor((solid.t - reach - self.origin) / _VOXEL_M).astype(int),
            0,
            self.shape,
        )
        high = np.clip(
            np.ceil((solid.t + reach - self.origin) / _VOXEL_M).astype(int) + 1,
            0,
            self.shape,
        )
        axes = [self.origin[k] + _VOXEL_M * np.arange(low[k], high[k]) for k in range(3)]
        xyz = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        block = self.values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        np.minimum(
            block,
            solid.sdf(solid.to_local(xyz)),
            out=block,
            casting="unsafe",
        )

    def __call__(self, xyz: ndarray) -> ndarray:
        """Trilinear distance at world points. [N, 3] -> [N]"""
        from scipy.ndimage import map_coordinates

        at = ((xyz - self.origin) / _VOXEL_M).T
        return map_coordinates(self.values, at, order=1, mode="nearest", output=np.float32)


def irradiance(grid: DistanceGrid, xyz_W: ndarray, normal_W: ndarray) -> ndarray:
    """Light that falls on surface points, linear RGB. [N, 3]"""
    start = xyz_W + _LIFT_M * normal_W
    upward = 0.5 + 0.5 * normal_W[:, 2:]
    ambient = upward * _AMBIENT_UP + (1 - upward) * _AMBIENT_DOWN
    total = ambient * _openness(grid, start, normal_W)[:, None]
    for light in LIGHTS:
        total += _direct(grid, light, start, normal_W)
    return total


def _direct(grid: DistanceGrid, light: Light, start: ndarray, normal: ndarray) -> ndarray:
    to_light = np.array(light.position) - start
    distance = np.linalg.norm(to_light, axis=1)
    direction = to_light / np.maximum(distance, 1e-6)[:, None]
    # A source as large as seen from here wraps around the horizon of the surface a little.
    wrap = light.radius_m / np.maximum(distance, 2 * light.radius_m)
    cosine = np.clip(
        ((direction * normal).sum(1) + wrap) / (1 + wrap),
        0,
        1,
    )
    axis = np.array(light.axis) / np.linalg.norm(light.axis)
    share_on_axis = 0.5 - 0.5 * (direction @ axis)
    lobe = light.backward + (1 - light.backward) * np.clip(2.4 * share_on_axis - 0.9, 0, 1)
    strength = cosine * lobe / (distance**2 + 0.25)
    lit_points = np.flatnonzero(strength > 1e-4)
    strength[lit_points] *= _shadow(
        grid,
        light,
        start[lit_points],
        direction[lit_points],
        distance[lit_points],
    )
    return strength[:, None] * np.array(light.colour)


def _shadow(
    grid: DistanceGrid, light: Light, start: ndarray, direction: ndarray, distance: ndarray
) -> ndarray:
    """Free share of the cone from each point to the light. [N]"""
    free = np.ones(len(start), np.float32)
    s = np.full(len(start), 0.03)
    rows = np.arange(len(start))
    for _ in range(40):
        h = grid(start[rows] + s[rows, None] * direction[rows])
        width = s[rows] * light.radius_m / distance[rows] + 0.02
        free[rows] = np.minimum(free[rows], h / width)
        s[rows] += np.clip(h, 0.03, _REACH_M)
        rows = rows[(s[rows] < distance[rows] - light.radius_m) & (free[rows] > -1)]
        if rows.size == 0:
            break
    free = np.clip(free, -1, 1)
    return 0.25 * (1 + free) ** 2 * (2 - free)


def _openness(grid: DistanceGrid, start: ndarray, normal: ndarray) -> ndarray:
    """Free share of the hemisphere, from one cone along the normal and five around it. [N]"""
    helper = np.where(
        np.abs(normal[:, 2:]) < 0.9,
        [[0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0]],
    )
    tangent = np.cross(helper, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normal, tangent)
    total = np.zeros(len(start))
    for k in range(6):
        tilt, turn = (0.0, 0.0) if k == 0 else (np.radians(58), 2 * np.pi * k / 5)
        direction = np.cos(tilt) * normal + np.sin(tilt) * (
            np.cos(turn) * tangent + np.sin(turn) * other
        )
        free = np.ones(len(start))
        for s in (0.04, 0.09, 0.18, 0.32):
            p = start + s * direction
            h = np.minimum(grid(p), shell_distance(p) + 0.02)
            free = np.minimum(
                free,
                np.clip((h + 0.25 * s) / (0.75 * s), 0, 1),
            )
        total += free * (0.25 if k == 0 else 0.15)
    return 0.12 + 0.88 * total
