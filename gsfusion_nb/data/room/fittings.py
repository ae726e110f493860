"""Lamps, the plant, curtains and the radiator: each function returns one piece as solids, as in
``furniture``."""

import numpy as np

from . import materials
from .furniture import WHITE
from .painted import ball, box, cone, drawn, plain, rod
from .solids import Colour, Solid

SOIL = plain(0.2, 0.14, 0.1)


def floor_lamp() -> list[Solid]:
    """A shade on a thin pole, 1.6 m high."""
    metal = plain(0.16, 0.15, 0.15)
    return [
        cone(
            (0, 0, 0),
            0.025,
            (0.14, 0.13),
            metal,
            hide="bottom",
        ),
        cone(
            (0, 0, 0.025),
            1.32,
            (0.011, 0.011),
            metal,
            hide="bottom top",
        ),
        cone(
            (0, 0, 1.34),
            0.26,
            (0.19, 0.13),
            plain(1.0, 0.88, 0.68, glow=0.97),
            occludes=False,
        ),
    ]


def pendant(length: float = 0.62) -> list[Solid]:
    """A lamp that hangs from its origin on the ceiling."""
    metal = plain(0.82, 0.45, 0.25)
    bulb = plain(1.0, 0.95, 0.85, glow=1.0)
    z = -length
    return [
        cone(
            (0, 0, -0.025),
            0.025,
            (0.05, 0.05),
            WHITE,
            hide="top",
        ),
        cone(
            (0, 0, z + 0.16),
            length - 0.18,
            (0.004, 0.004),
            plain(0.1, 0.1, 0.1),
            hide="bottom top",
        ),
        cone(
            (0, 0, z),
            0.16,
            (0.17, 0.035),
            metal,
            special={"bottom": bulb},
            occludes=False,
        ),
        ball((0, 0, z), 0.05, bulb, occludes=False),
    ]


def plant(rng: np.random.Generator, leaves: int = 26) -> list[Solid]:
    """A potted plant: leaves on stems that lean outwards."""
    clay = drawn(
        0.005,
        materials.speckled,
        (0.72, 0.42, 0.29),
        (0.62, 0.34, 0.23),
        0.02,
        0.3,
    )
    solids: list[Solid] = [
        cone(
            (0, 0, 0),
            0.28,
            (0.12, 0.17),
            clay,
            hide="bottom",
            special={"top": SOIL},
        ),
        cone(
            (0, 0, 0.25),
            0.04,
            (0.18, 0.185),
            clay,
            special={"top": SOIL},
        ),
    ]
    stem = plain(0.33, 0.45, 0.2)
    for k in range(leaves):
        turn = 137.5 * k + rng.uniform(-15, 15)
        z = 0.36 + 0.82 * k / leaves + rng.uniform(-0.04, 0.04)
        reach = 0.2 - 0.12 * k / leaves + rng.uniform(0, 0.05)
        drop = rng.uniform(-25, 35)
        c = np.cos(np.radians(turn))
        s = np.sin(np.radians(turn))
        foot = (0.02 * c, 0.02 * s, 0.28)
        tip = (reach * c, reach * s, z)
        half = rng.uniform(0.085, 0.13)
        p = np.radians(drop)
        centre = (
            tip[0] + half * c * np.cos(p),
            tip[1] + half * s * np.cos(p),
            tip[2] - half * np.sin(p),
        )
        tone = rng.uniform(0.8, 1.15)
        green = drawn(0.004, materials.leaf, (0.22 * tone, 0.46 * tone, 0.18 * tone))
        solids.append(rod(foot, tip, 0.004, stem, hide="bottom top"))
        solids.append(
            ball(
                centre,
                (half, 0.4 * half, 0.006),
                green,
                turn=(turn, drop, rng.uniform(-20, 20)),
            )
        )
    return solids


def curtain(width: float, height: float, colour: Colour) -> list[Solid]:
    """Folds as a row of vertical columns; the origin is at the lower edge."""
    cloth = drawn(0.005, materials.fabric, colour, contrast=0.12)
    n = round(width / 0.062)
    radii = [0.036 if k % 2 == 0 else 0.028 for k in range(n)]
    return [
        cone(
            ((k + 0.5) * width / n - width / 2, 0.012 * (-1) ** k, 0),
            height,
            (r, 0.9 * r),
            cloth,
        )
        for k, r in enumerate(radii)
    ]


def radiator(width: float = 1.2) -> list[Solid]:
    """A ribbed radiator: upright tubes between a lower and an upper pipe."""
    foot_m = 0.14
    height_m = 0.56
    radius_m = 0.025
    n_ribs = round(width / 0.06)
    spacing_m = width / n_ribs
    ribs = []
    for k in range(n_ribs):
        x = (k + 0.5) * spacing_m - width / 2
        ribs.append(cone((x, 0, foot_m), height_m, (radius_m, radius_m), WHITE))
    pipes = [box((0, 0.01, z), (width, 0.04, 0.05), WHITE, hide="x- x+") for z in (0.2, 0.64)]
    return [*ribs, *pipes]
