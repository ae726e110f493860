"""The room ready to be rendered: solids, patches, and the textured and lit atlas."""

import functools
import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy import ndarray

from ...files import cache_folder
from .atlas import WIDTH, AtlasLayout, pack, paste, with_mips
from .image_cache import cached
from .interior import SHELL_SOLIDS, interior
from .light import DistanceGrid, irradiance
from .patches import CurvedPatch, FlatPatches, compile_patches
from .solids import Paint, Solid

log = logging.getLogger(__name__)

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
def load_scene(seed: int, cache: bool = True, moved: str = "none") -> Scene:
    """The room for ``seed``, with what ``moved`` names at another place; its atlas is baked once
    (seconds) and then read from the disk cache."""
    solids = interior(seed, moved)
    charts = [
        Chart(solid=i, face=f, paint=p) for i, s in enumerate(solids) for f, p in s.paints.items()
    ]
    layout = _lay_out(solids, charts)
    number = {(c.solid, c.face): k for k, c in enumerate(charts)}
    flat, curved_patches = compile_patches(solids, number)
    chart_of_patch = np.concatenate(
        [flat.chart, [int(c.charts.max()) for c in curved_patches]]
    ).astype(int)
    key = hashlib.sha256(f"atlas {version()} {seed}{place_of(moved)}".encode()).hexdigest()[:16]
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


def place_of(moved: str) -> str:
    """What is added to the names of cached files of a room in which something was moved."""
    return "" if moved == "none" else f" moved {moved}"


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
