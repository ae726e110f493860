"""Furniture: each function returns one piece as solids around the point it stands on, front towards
-y."""

from itertools import product

import numpy as np

from . import materials
from . import thing_drawings as draw
from .painted import box, cone, drawn, plain, rod
from .solids import Colour, Solid

OAK = (0.72, 0.53, 0.34)

_WALNUT = (0.45, 0.30, 0.20)

WHITE = plain(0.93, 0.92, 0.89)


def sofa() -> list[Solid]:
    """Two seats, 1.9 m wide, 0.9 m deep, with loose cushions and three pillows."""
    cloth = drawn(0.003, materials.fabric, (0.33, 0.46, 0.50))
    rough = drawn(0.008, materials.fabric, (0.31, 0.43, 0.47))
    solids: list[Solid] = [
        box(
            (0, 0.02, 0.24),
            (1.86, 0.82, 0.24),
            rough,
            radius=0.03,
            hide="y+",
        ),
        box(
            (0, 0.36, 0.55),
            (1.86, 0.2, 0.6),
            cloth,
            radius=0.06,
            hide="y+ z-",
        ),
        box(
            (-0.86, -0.02, 0.4),
            (0.2, 0.88, 0.5),
            cloth,
            radius=0.06,
            special={"y+": rough},
        ),
        box(
            (0.86, -0.02, 0.4),
            (0.2, 0.88, 0.5),
            cloth,
            radius=0.06,
            special={"y+": rough},
        ),
    ]
    for x in (-0.375, 0.375):
        solids.append(
            box(
                (x, -0.08, 0.42),
                (0.745, 0.7, 0.18),
                cloth,
                radius=0.05,
                hide="z-",
            )
        )
        solids.append(
            box(
                (x, 0.21, 0.68),
                (0.73, 0.18, 0.42),
                cloth,
                radius=0.07,
                turn=(0, 0, -12),
                hide="z-",
            )
        )
    cream = (0.85, 0.82, 0.74)
    mustard = drawn(0.002, materials.fabric, (0.83, 0.62, 0.22), contrast=0.14)
    bands = drawn(
        0.002,
        materials.stripes,
        [cream, (0.70, 0.28, 0.22), cream, (0.2, 0.25, 0.38)],
        0.03,
    )
    word = drawn(
        0.0015,
        draw.lettered_cushion,
        "HOME",
        (0.88, 0.86, 0.8),
        (0.25, 0.22, 0.3),
    )
    for centre, size, paint, turn, special in (
        ((-0.58, 0.03, 0.70), (0.4, 0.12, 0.4), mustard, (14, 0, -24), {}),
        ((0.2, 0.04, 0.68), (0.42, 0.12, 0.34), bands, (-6, 0, -24), {}),
        ((0.6, 0.02, 0.70), (0.4, 0.12, 0.4), mustard, (-16, 0, -22), {"y-": word}),
    ):
        solids.append(
            box(
                centre,
                size,
                paint,
                radius=0.055,
                turn=turn,
                special=special,
            )
        )
    leg = plain(0.25, 0.17, 0.11)
    corners = product((-0.84, 0.84), (-0.32, 0.34))
    return [
        *solids,
        *(
            cone(
                (x, y, 0),
                0.13,
                (0.018, 0.028),
                leg,
                hide="bottom top",
            )
            for x, y in corners
        ),
    ]


def table(
    width: float = 1.4,
    depth: float = 0.8,
    height: float = 0.74,
) -> list[Solid]:
    """A wooden table with tapered legs and an apron."""
    top = drawn(0.0025, materials.wood, OAK)
    side = drawn(0.006, materials.wood, OAK)
    solids: list[Solid] = [
        box(
            (0, 0, height - 0.018),
            (width, depth, 0.036),
            side,
            radius=0.006,
            special={"z+": top},
        )
    ]
    x = 0.5 * width - 0.07
    y = 0.5 * depth - 0.07
    for i, j in product((-1, 1), repeat=2):
        solids.append(
            cone(
                (i * x, j * y, 0),
                height - 0.036,
                (0.02, 0.034),
                side,
                hide="bottom top",
            )
        )
    z = height - 0.036 - 0.04
    h = 0.08
    for s in (-1, 1):
        solids.append(
            box(
                (0, s * y, z),
                (2 * x, 0.022, h),
                side,
                hide="x- x+ z+",
            )
        )
        solids.append(
            box(
                (s * x, 0, z),
                (0.022, 2 * y, h),
                side,
                hide="y- y+ z+",
            )
        )
    return solids


def chair(seat: Colour) -> list[Solid]:
    """A wooden chair with a padded seat; its front faces -y."""
    frame = drawn(0.006, materials.wood, _WALNUT, "v")
    slat = drawn(0.005, materials.wood, _WALNUT)
    pad = drawn(0.0025, materials.fabric, seat, contrast=0.15)
    solids: list[Solid] = [
        box((0, 0, 0.43), (0.42, 0.42, 0.03), slat),
        box(
            (0, -0.01, 0.46),
            (0.39, 0.38, 0.045),
            pad,
            radius=0.02,
            hide="z-",
        ),
    ]
    for x in (-0.18, 0.18):
        solids.append(
            cone(
                (x, -0.18, 0),
                0.42,
                (0.014, 0.02),
                frame,
                hide="bottom top",
            )
        )
        solids.append(
            rod(
                (x, 0.21, 0),
                (x, 0.18, 0.45),
                0.018,
                frame,
                hide="bottom",
            )
        )
        solids.append(
            rod(
                (x, 0.18, 0.43),
                (x, 0.25, 0.9),
                0.017,
                frame,
            )
        )
    for z, y in ((0.84, 0.24), (0.70, 0.22), (0.58, 0.20)):
        solids.append(
            box(
                (0, y, z),
                (0.35, 0.018, 0.07),
                slat,
                turn=(0, 0, -8),
            )
        )
    return solids


def coffee_table() -> list[Solid]:
    """A low round table on three splayed legs."""
    top = drawn(0.0025, materials.wood, _WALNUT)
    side = drawn(0.006, materials.wood, _WALNUT)
    leg = drawn(0.006, materials.wood, _WALNUT, "v")
    solids = []
    solids.append(
        cone(
            (0, 0, 0.38),
            0.035,
            (0.36, 0.37),
            side,
            special={"top": top},
        )
    )
    for a in (90, 210, 330):
        c = np.cos(np.radians(a))
        s = np.sin(np.radians(a))
        solids.append(
            rod(
                (0.3 * c, 0.3 * s, 0),
                (0.22 * c, 0.22 * s, 0.38),
                0.018,
                leg,
                hide="bottom top",
            )
        )
    return solids
