"""The room ready to be rendered: solids, patches, and the textured and lit atlas, with its cache on
disk.

The atlas holds all charts in one image with its mip levels, so that one ``cv2.remap`` textures a
whole view. Level 0 fills the left part; level l, reduced by 2^l, is in the column to its right.
Every chart is surrounded by at least ``GUTTER`` texels that repeat (or, around a cone or ellipsoid,
wrap) its border, in a cell aligned to 2^LEVELS: half a texel of the coarsest level, which is what
bilinear lookups reach, so no level mixes neighbouring charts.

The light is baked: lamps with soft shadows, daylight from the window, and ambient light that is
darker near contacts. Shadows and ambient occlusion are cones traced through a coarse distance grid:
the narrowest clearance along a cone, relative to its width, is the share of it that is free. The
result is smooth, as light from large sources is.
"""

import functools
import hashlib
import io
import logging
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy import ndarray

from ...errors import ArgumentError
from ...files import atomic_file, cache_folder, read_bytes
from .interior import SHELL_SOLIDS, interior
from .raycast import CurvedPatch, FlatPatches, compile_patches
from .solids import SIZE_M, Paint, Solid, shell_distance

log = logging.getLogger(__name__)

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


def cached(
    path: Path | None,
    make: Callable[[], dict[str, ndarray]],
    fits: Callable[[dict[str, ndarray]], bool] = bool,
) -> dict[str, ndarray]:
    """The arrays of the archive ``path``; made and stored where it is absent or damaged, or its
    arrays do not fit.

    Two processes may store the same file at once: each writes its own temporary file, and the last
    one moved is kept. Without a path nothing is stored.
    """
    entry = _load(path) if path else None
    if entry is None or not fits(entry):
        entry = make()
        if path:
            _store(path, entry)
    return entry


def _store(path: Path, arrays: dict[str, ndarray]) -> None:
    """Save arrays in one archive with checksums, uint8 and uint16 ones as PNGs; failing to write is
    only logged."""

    def encoded(v: ndarray) -> ndarray:
        is_image = v.dtype in (np.uint8, np.uint16)
        return cv2.imencode(".png", v, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1] if is_image else v

    try:
        with atomic_file(path) as temporary:
            np.savez(
                temporary,
                allow_pickle=False,
                **{k: encoded(v) for k, v in arrays.items()},
            )
    except OSError as e:
        _warn_once(str(path.parent), str(e))


@functools.cache
def _warn_once(folder: str, reason: str) -> None:
    log.warning("cannot write to the cache folder %s: %s", folder, reason)


def _load(path: Path) -> dict[str, ndarray] | None:
    """Arrays written by ``_store``; None where they are absent or damaged."""
    try:
        with np.load(io.BytesIO(read_bytes(path, "cached arrays")), allow_pickle=False) as archive:
            arrays: dict[str, Any] = {name: archive[name] for name in archive.files}
        arrays = {
            k: cv2.imdecode(v, cv2.IMREAD_UNCHANGED) if v.dtype == np.uint8 else v
            for k, v in arrays.items()
        }
        if any(v is None for v in arrays.values()):
            raise ArgumentError("a picture is not a PNG")
        return arrays
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, cv2.error) as e:
        log.warning("%s is damaged and will be made again: %s", path, e)
        return None


LEVELS = 4
GUTTER = 8
WIDTH = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class AtlasLayout:
    """Position of each chart at level 0, texels."""

    x: ndarray
    y: ndarray
    w: ndarray
    h: ndarray
    texel_m: ndarray
    """Edge of a texel on the surface, metres (mean of both directions)."""
    height: int
    """Rows of the picture."""


def pack(
    sizes_px: Sequence[tuple[int, int]],
    texel_m: Sequence[float],
) -> AtlasLayout:
    """Place charts of the given (width, height) in rows, tallest first."""
    step = 2**LEVELS
    n = len(sizes_px)
    x = np.zeros(n, int)
    y = np.zeros(n, int)
    order = sorted(
        range(n),
        key=lambda i: (-sizes_px[i][1], i),
    )
    shelf_y = 0
    shelf_h = 0
    cursor = 0
    for i in order:
        outer_w, outer_h = (-(-(s + 2 * GUTTER) // step) * step for s in sizes_px[i])
        if cursor + outer_w > WIDTH:
            shelf_y = shelf_y + shelf_h
            shelf_h = 0
            cursor = 0
        shelf_h = max(shelf_h, outer_h)
        x[i] = cursor + GUTTER
        y[i] = shelf_y + GUTTER
        cursor += outer_w
    w, h = np.array(sizes_px).T
    return AtlasLayout(
        x=x,
        y=y,
        w=w,
        h=h,
        texel_m=np.array(texel_m, float),
        height=shelf_y + shelf_h,
    )


def paste(
    level0: ndarray,
    layout: AtlasLayout,
    i: int,
    picture: ndarray,
    wraps: bool,
) -> None:
    """Write chart ``i`` and its gutter into the level-0 picture (in place)."""
    step = 2**LEVELS
    x, y, w, h = (int(a[i]) for a in (layout.x, layout.y, layout.w, layout.h))
    right, bottom = (-(-(s + 2 * GUTTER) // step) * step - s - GUTTER for s in (w, h))
    with_border = np.pad(
        picture,
        ((GUTTER, bottom), (0, 0), (0, 0)),
        mode="edge",
    )
    with_border = np.pad(
        with_border,
        ((0, 0), (GUTTER, right), (0, 0)),
        mode="wrap" if wraps else "edge",
    )
    level0[y - GUTTER : y + h + bottom, x - GUTTER : x + w + right] = with_border


def with_mips(level0: ndarray) -> ndarray:
    """The level-0 picture [H, WIDTH, 3] with its box-filtered mip levels beside it. [H, 1.5 WIDTH,
    3]"""
    height = level0.shape[0]
    atlas = np.zeros((height, WIDTH + WIDTH // 2, 3), np.uint8)
    atlas[:, :WIDTH] = level0
    y = 0
    level = level0
    for _ in range(LEVELS):
        level = cv2.resize(
            level,
            (level.shape[1] // 2, level.shape[0] // 2),
            interpolation=cv2.INTER_AREA,
        )
        atlas[y : y + level.shape[0], WIDTH : WIDTH + level.shape[1]] = level
        y += level.shape[0]
    return atlas


def level_offsets(height: int) -> tuple[ndarray, ndarray]:
    """Column and row of each level's corner in the combined picture, texels. [LEVELS + 1] each"""
    rows = [0, 0]
    for level in range(1, LEVELS):
        rows.append(rows[-1] + (height >> level))
    return np.array([0] + [WIDTH] * LEVELS, np.float32), np.array(rows, np.float32)


def texels(atlas: ndarray, x: ndarray, y: ndarray) -> ndarray:
    """Bilinear texels at columns and rows of the combined picture. [N] -> [N, 3] uint8"""
    n = x.size
    side = 1024 if n >= 1024 else n  # cv2.remap takes pictures of fewer than 2^15 rows and columns
    blocks = np.zeros((2, -(-n // side) * side), np.float32)
    blocks[0, :n] = x
    blocks[1, :n] = y
    map_x, map_y = blocks.reshape(2, -1, side)
    return cv2.remap(atlas, map_x, map_y, cv2.INTER_LINEAR).reshape(-1, 3)[:n]


SCENE_VERSION = 2
"""Increased whenever the appearance or shape of the room changes, so that caches of older versions
are not used."""

_LIGHT_TEXEL_M = 0.04


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One painted face."""

    solid: int
    face: str
    paint: Paint


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """The data for rendering, distance queries and meshing."""

    solids: list[Solid]
    charts: list[Chart]
    layout: AtlasLayout
    flat: FlatPatches
    curved: list[CurvedPatch]
    atlas: ndarray
    """Lit sRGB texture of all charts with mip levels. [H, W, 3] uint8"""
    texel_of_patch: ndarray
    """Edge of a texel by patch number, metres. [P]"""


@functools.lru_cache(maxsize=2)
def load_scene(seed: int, cache: bool = True) -> Scene:
    """The room for ``seed``; its atlas is baked once (seconds) and then read from the disk
    cache."""
    solids = interior(seed)
    charts = [
        Chart(solid=i, face=f, paint=p) for i, s in enumerate(solids) for f, p in s.paints.items()
    ]
    layout = _lay_out(solids, charts)
    number = {(c.solid, c.face): k for k, c in enumerate(charts)}
    flat, curved_patches = compile_patches(solids, number)
    chart_of_patch = np.concatenate(
        [flat.chart, [int(c.charts.max()) for c in curved_patches]]
    ).astype(int)
    key = hashlib.sha256(f"atlas {version()} {seed}".encode()).hexdigest()[:16]
    level0 = cached(
        cache_folder() / "room" / f"atlas-{key}.npz" if cache else None,
        lambda: {"atlas": _painted(solids, charts, layout, seed)},
        lambda entry: entry["atlas"].shape == (layout.height, WIDTH, 3),
    )["atlas"]
    return Scene(
        solids=solids,
        charts=charts,
        layout=layout,
        flat=flat,
        curved=curved_patches,
        atlas=with_mips(level0),
        texel_of_patch=layout.texel_m[chart_of_patch],
    )


def version() -> str:
    """Version of cached images: that of this room, and that of OpenCV, which draws its text."""
    return f"{SCENE_VERSION} opencv {cv2.__version__}"


def _lay_out(solids: Sequence[Solid], charts: Sequence[Chart]) -> AtlasLayout:
    sizes = []
    texels = []
    for chart in charts:
        size_m = solids[chart.solid].face_size_m(chart.face)
        w, h = (int(np.clip(round(s / chart.paint.texel_m), 4, WIDTH // 2)) for s in size_m)
        sizes.append((w, h))
        texels.append(0.5 * (size_m[0] / w + size_m[1] / h))
    return pack(sizes, texels)


def _painted(solids, charts, layout: AtlasLayout, seed: int) -> ndarray:
    log.info("computing textures and lighting of the room; takes a few seconds, only once")
    level0 = np.zeros((layout.height, WIDTH, 3), np.uint8)
    light = _light_maps(solids, charts)
    for k, chart in enumerate(charts):
        picture = _picture(
            chart.paint,
            int(layout.w[k]),
            int(layout.h[k]),
            layout.texel_m[k],
            [seed, 2, k],
        )
        paste(
            level0,
            layout,
            k,
            _lit(picture, chart.paint, light[k]),
            chart.face in ("side", "skin"),
        )
    return level0


def _picture(
    paint: Paint,
    w: int,
    h: int,
    texel_m: float,
    seed: list[int],
) -> ndarray:
    if paint.draw is None:
        return np.full(
            (h, w, 3),
            np.round(255 * np.array(paint.colour)),
            np.uint8,
        )
    return paint.draw(w, h, texel_m, np.random.default_rng(seed))


def _light_maps(solids: Sequence[Solid], charts: Sequence[Chart]) -> list[ndarray]:
    """Display-space light on a coarse raster of every chart. [h, w, 3] each"""
    points = []
    normals = []
    shapes = []
    for chart in charts:
        solid = solids[chart.solid]
        w, h = (
            max(2, round(s / max(_LIGHT_TEXEL_M, chart.paint.texel_m)))
            for s in solid.face_size_m(chart.face)
        )
        u, v = np.meshgrid(
            (np.arange(w) + 0.5) / w,
            (np.arange(h) + 0.5) / h,
        )
        p, n = solid.surface(chart.face, u.ravel(), v.ravel())
        points.append(p @ solid.R.T + solid.t)
        normals.append(n @ solid.R.T)
        shapes.append((h, w, 3))
    grid = DistanceGrid(solids[SHELL_SOLIDS:])
    light = irradiance(grid, np.concatenate(points), np.concatenate(normals))
    cuts = np.cumsum([h * w for h, w, _ in shapes])[:-1]
    return [
        part.reshape(shape)
        for part, shape in zip(
            np.split(_exposed(light), cuts),
            shapes,
            strict=True,
        )
    ]


def _exposed(light: ndarray) -> ndarray:
    """Convert linear light to a factor on sRGB values: compress it near 1, then apply the display's
    gamma.

    Without the compression, the product of gamma-encoded values is the gamma-encoded product.
    """
    bright = np.where(
        light > 0.7,
        0.7 + 0.45 * np.tanh((light - 0.7) / 0.45),
        light,
    )
    return (bright ** (1 / 2.2)).astype(np.float32)


def _lit(picture: ndarray, paint: Paint, light: ndarray) -> ndarray:
    if paint.glow > 0:
        return np.clip(picture * np.float32(paint.glow), 0, 255).astype(np.uint8)
    h, w = picture.shape[:2]
    factor = cv2.resize(light, (w, h), interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(picture, factor, dtype=cv2.CV_8U)
