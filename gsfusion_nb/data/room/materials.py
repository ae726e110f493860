"""What the room's surfaces look like: paint, wood, brick, fabric, wallpaper, leaves.

Each is a function (width_px, height_px, texel_m, rng, ...) -> uint8 [height_px, width_px, 3].
Colours are sRGB, 0..1. Lengths are metres, so that a pattern has the same size with any texel size.
"""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
from numpy import ndarray

Number = int | float

Colour = tuple[Number, Number, Number]

Draw = Callable[[int, int, float, np.random.Generator], ndarray]


def noise(
    w: int,
    h: int,
    cell_w_px: float,
    cell_h_px: float,
    rng: np.random.Generator,
) -> ndarray:
    """Smooth random field in about -1..1 whose features are ``cell`` pixels large. [h, w]
    float32"""
    shape = (
        max(2, int(np.ceil(h / max(cell_h_px, 1))) + 1),
        max(2, int(np.ceil(w / max(cell_w_px, 1))) + 1),
    )
    coarse = rng.uniform(-1, 1, shape).astype(np.float32)
    return cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)


def tint(colour: Colour, shade: ndarray) -> ndarray:
    """``colour`` times ``shade`` [h, w] (or [h, w, 3]) as uint8."""
    shade = shade[..., None] if shade.ndim == 2 else shade
    return np.clip(
        shade * (255 * np.array(colour, np.float32)),
        0,
        255,
    ).astype(np.uint8)


MOTTLE_M = 0.4
"""Size of the lighter and darker patches of wall paint."""


def paint(
    w: int,
    h: int,
    texel_m: float,
    rng: np.random.Generator,
    colour: Colour,
    gradient: float = 0.06,
    mottle: float = 0.008,
) -> ndarray:
    """Smooth wall paint.

    Args:
        w, h, texel_m, rng: As for every material.
        colour: At the top.
        gradient: How much darker the bottom is, as a share.
        mottle: How much lighter and darker its patches are, as a share.
    """
    ramp = np.linspace(1.0, 1.0 - gradient, h, dtype=np.float32)[:, None]
    patch_px = MOTTLE_M / texel_m
    return tint(colour, ramp + mottle * noise(w, h, patch_px, patch_px, rng))


def wood(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    along: str = "u",
    strength: float = 0.2,
) -> ndarray:
    """Grain along ``u`` or ``v``: bent bands plus fine fibres."""
    if along == "v":
        return np.ascontiguousarray(
            wood(h, w, texel_m, rng, colour, "u", strength).transpose(1, 0, 2)
        )
    y = np.arange(h, dtype=np.float32)[:, None] * np.float32(texel_m / 0.018)
    bend = 1.6 * noise(w, h, 0.5 / texel_m, 0.05 / texel_m, rng) + rng.uniform(0, 6)
    bands = np.sin(2 * np.pi * (0.55 * y + bend))
    fibres = noise(w, h, 0.12 / texel_m, 0.0025 / texel_m, rng)
    shade = 1.0 + strength * (
        0.35 * bands + 0.45 * fibres + 0.3 * noise(w, h, 0.3 / texel_m, 0.08 / texel_m, rng)
    )
    return tint(colour, np.stack([shade, shade**1.15, shade**1.3], -1))


def planks(
    w, h, texel_m, rng, colour: Colour, plank_m: float = 0.14, length_m: float = 1.3
) -> ndarray:
    """Floor boards along u, each with its own tone, length and grain, and dark joints."""
    image = wood(w, h, texel_m, rng, colour, "u", 0.25).astype(np.float32)
    rows = max(1, round(h * texel_m / plank_m))
    joint = max(1, round(0.003 / texel_m))
    edges = np.linspace(0, h, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        start_px = -int(rng.uniform(0, length_m) / texel_m)
        while start_px < w:
            right = start_px + int(rng.uniform(0.7, 1.2) * length_m / texel_m)
            board = image[top:bottom, max(start_px, 0) : max(right, 0)]
            board *= rng.uniform(0.8, 1.12) * np.array(
                [1, rng.uniform(0.97, 1.02), rng.uniform(0.92, 1.04)]
            )
            image[top:bottom, max(right - joint, 0) : max(right, 0)] *= 0.45
            start_px = right
        image[top : top + joint] *= 0.45
    return np.clip(image, 0, 255).astype(np.uint8)


def brick(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    mortar: Colour = (0.78, 0.75, 0.70),
    size_m: tuple[float, float] = (0.24, 0.08),
) -> ndarray:
    """Running bond; bricks vary in tone and are shaded at the lower edge."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(texel_m)
    wobble = 0.003 * noise(w, h, 0.03 / texel_m, 0.03 / texel_m, rng)
    row = np.floor(v / size_m[1]).astype(int)
    u = u + 0.5 * size_m[0] * (row % 2)
    col = np.floor(u / size_m[0]).astype(int)
    fu = u - col * size_m[0] + wobble
    fv = v - row * size_m[1] + wobble
    edge = np.minimum(
        np.minimum(fu, size_m[0] - fu),
        np.minimum(fv, size_m[1] - fv),
    )
    body = np.clip((edge - 0.005) / 0.004, 0, 1)[..., None]
    tone = rng.uniform(
        0.72,
        1.15,
        (row.max() + 1, col.max() + 1, 1),
    ) * rng.uniform(
        0.94,
        1.06,
        (row.max() + 1, col.max() + 1, 3),
    )
    rough = 1 + 0.10 * noise(w, h, 0.012 / texel_m, 0.012 / texel_m, rng) - 0.10 * (fv / size_m[1])
    bricks = tone.astype(np.float32)[row, col] * np.array(colour, np.float32) * rough[..., None]
    joints = (
        np.array(mortar, np.float32)
        * (1 + 0.05 * noise(w, h, 0.02 / texel_m, 0.02 / texel_m, rng))[..., None]
    )
    return tint((1, 1, 1), body * bricks + (1 - body) * joints)


def fabric(
    w, h, texel_m, rng, colour: Colour, thread_m: float = 0.006, contrast: float = 0.10
) -> ndarray:
    """Plain weave with uneven threads and large worn areas."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(2 * np.pi * texel_m / thread_m)
    weave = np.sin(u) * np.sin(v) if texel_m < 0.4 * thread_m else np.zeros_like(u)
    uneven = noise(w, h, 0.08 / texel_m, 0.004 / texel_m, rng) + noise(
        w, h, 0.004 / texel_m, 0.08 / texel_m, rng
    )
    wear = noise(w, h, 0.2 / texel_m, 0.2 / texel_m, rng)
    return tint(colour, 1 + contrast * (0.6 * weave + 0.45 * uneven) + 0.05 * wear)


def stripes(
    w,
    h,
    texel_m,
    rng,
    colours: list[Colour],
    width_m: float,
    along: str = "u",
) -> ndarray:
    """Woven bands of the given colours, stacked along u or v."""
    n = w if along == "u" else h
    band = (np.arange(n) * texel_m / width_m).astype(int) % len(colours)
    rows = np.array(colours, np.float32)[band]
    rows = rows[None, :] if along == "u" else rows[:, None]
    return (fabric(w, h, texel_m, rng, (1, 1, 1), contrast=0.08) * rows).astype(np.uint8)


def rug(
    w,
    h,
    texel_m,
    rng,
    colours: tuple[Colour, Colour, Colour],
    cell_m: float = 0.2,
    border_m: float = 0.12,
) -> ndarray:
    """Checker with a diamond in every cell, inside two border bands."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(texel_m)
    edge = np.minimum(
        np.minimum(u, w * texel_m - u),
        np.minimum(v, h * texel_m - v),
    )
    fu = np.abs(u / cell_m % 1 - 0.5)
    fv = np.abs(v / cell_m % 1 - 0.5)
    checker = (np.floor(u / cell_m) + np.floor(v / cell_m)).astype(int) % 2
    index = np.where(fu + fv < 0.25, 2, checker)
    index = np.where(edge < border_m, 0, index)
    index = np.where(edge < 0.75 * border_m, 2, index)
    index = np.where(edge < 0.45 * border_m, 1, index)
    index = np.where(edge < 0.2 * border_m, 0, index)
    pile = fabric(
        w,
        h,
        texel_m,
        rng,
        (1, 1, 1),
        thread_m=0.012,
        contrast=0.16,
    )
    return (pile * np.array(colours, np.float32)[index]).astype(np.uint8)


def wallpaper(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    ink: Colour,
    cell_m: float = 0.22,
) -> ndarray:
    """Rows of leaf sprigs, every second row shifted by half."""
    image = paint(w, h, texel_m, rng, colour, 0.04)
    rgb = tuple(int(255 * c) for c in ink)
    cell = cell_m / texel_m
    for row in range(int(h / cell) + 2):
        for col in range(-1, int(w / cell) + 2):
            x = (col + 0.5 * (row % 2)) * cell
            y = row * cell
            cv2.line(
                image,
                (round(x), round(y - 0.3 * cell)),
                (round(x), round(y + 0.3 * cell)),
                rgb,
                1,
                cv2.LINE_AA,
            )
            for k in range(-2, 3):
                for side in (-1, 1):
                    at = (round(x + side * 0.11 * cell), round(y + 0.12 * k * cell))
                    axes = (max(1, round(0.11 * cell)), max(1, round(0.035 * cell)))
                    cv2.ellipse(
                        image,
                        at,
                        axes,
                        -35 * side,
                        0,
                        360,
                        rgb,
                        -1,
                        cv2.LINE_AA,
                    )
    return image


def speckled(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    dots: Colour,
    size_m: float = 0.004,
    share: float = 0.12,
) -> ndarray:
    """Fine dots on a plain ground: ceramic, fruit skin, soil."""
    field = noise(w, h, size_m / texel_m, size_m / texel_m, rng)
    mix = np.clip((field - 1 + 2 * share) * 6, 0, 1)[..., None]
    base = (
        np.array(colour, np.float32)
        * (1 + 0.08 * noise(w, h, 0.05 / texel_m, 0.05 / texel_m, rng))[..., None]
    )
    return tint(
        (1, 1, 1),
        base * (1 - mix) + np.array(dots, np.float32) * mix,
    )


def leaf(w, h, texel_m, rng, colour: Colour) -> ndarray:
    """Texture of a flat ellipsoid as a leaf: light midrib along x, side veins."""
    colat = np.linspace(0, np.pi, h, dtype=np.float32)[:, None]
    lon = np.linspace(
        0,
        2 * np.pi,
        w,
        dtype=np.float32,
    )[None]
    x = np.sin(colat) * np.cos(lon)
    y = np.abs(np.sin(colat) * np.sin(lon))
    veins = 0.16 * np.clip(
        1 - 4 * np.abs(np.sin(12 * (x - 0.6 * y))),
        0,
        1,
    )
    rib = 0.35 * np.clip(1 - 14 * y, 0, 1)
    return tint(
        colour,
        0.9 + veins + rib + 0.1 * noise(w, h, w / 6, h / 6, rng),
    )


def blank(w: int, h: int, colour: Colour) -> ndarray:
    """A picture of one colour. [h, w, 3] uint8"""
    return np.full((h, w, 3), rgb255(colour), np.uint8)


def rgb255(colour: Colour) -> tuple[int, int, int]:
    """A colour in OpenCV's form."""
    r, g, b = (int(255 * min(max(c, 0.0), 1.0)) for c in colour)
    return r, g, b
