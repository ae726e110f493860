"""Furniture and small objects: each function returns one piece as solids around the point it stands
on, front towards -y."""

from functools import partial
from itertools import product

import numpy as np

from . import drawings as draw
from .solids import Colour, Paint, Solid, Vector, ball, box, cone, drawn, plain, rod

_OAK = (0.72, 0.53, 0.34)
_WALNUT = (0.45, 0.30, 0.20)
WHITE = plain(0.93, 0.92, 0.89)
SOIL = plain(0.2, 0.14, 0.1)


def sofa() -> list[Solid]:
    """Two seats, 1.9 m wide, 0.9 m deep, with loose cushions and three pillows."""
    cloth = drawn(0.003, draw.fabric, (0.33, 0.46, 0.50))
    rough = drawn(0.008, draw.fabric, (0.31, 0.43, 0.47))
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
    mustard = drawn(0.002, draw.fabric, (0.83, 0.62, 0.22), contrast=0.14)
    bands = drawn(
        0.002,
        draw.stripes,
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
    top = drawn(0.0025, draw.wood, _OAK)
    side = drawn(0.006, draw.wood, _OAK)
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
    frame = drawn(0.006, draw.wood, _WALNUT, "v")
    slat = drawn(0.005, draw.wood, _WALNUT)
    pad = drawn(0.0025, draw.fabric, seat, contrast=0.15)
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


_TITLES = [
    "OCTREES",
    "LINEAR ALGEBRA",
    "OPTICS",
    "FIELD NOTES",
    "GEOMETRY",
    "RAYS",
    "KALMAN",
    "BIRDS",
    "JAZZ",
    "SPLINES",
    "COOKING",
    "ATLAS",
    "RUST",
    "NORDIC SEA",
    "CHESS",
    "TRAVELS",
    "POEMS",
    "VOXELS",
    "GARDENS",
    "DESIGN",
    "PRIMES",
    "MAPS",
    "THE HOUSE",
    "BRIDGES",
    "LIGHT",
    "SIGNALS",
    "NIGHT TRAIN",
    "ESSAYS",
    "GAUSS",
    "STATISTICS",
    "MOUNTAINS",
]
_CLOTHS = [
    (0.55, 0.14, 0.14),
    (0.13, 0.25, 0.42),
    (0.16, 0.36, 0.26),
    (0.80, 0.68, 0.42),
    (0.22, 0.22, 0.25),
    (0.74, 0.42, 0.18),
    (0.86, 0.84, 0.78),
    (0.42, 0.20, 0.36),
    (0.24, 0.48, 0.56),
    (0.62, 0.60, 0.28),
    (0.88, 0.72, 0.20),
    (0.35, 0.27, 0.20),
]


def _book(
    centre: Vector,
    size: Vector,
    rng: np.random.Generator,
    lean_deg: float = 0.0,
) -> Solid:
    colour = _CLOTHS[rng.integers(len(_CLOTHS))]
    ink = (0.95, 0.9, 0.75) if sum(colour) < 1.6 else (0.15, 0.12, 0.12)
    back = drawn(
        0.0014,
        draw.spine,
        _TITLES[rng.integers(len(_TITLES))],
        colour,
        ink,
    )
    paper = drawn(
        0.004,
        draw.stripes,
        [(0.93, 0.91, 0.84), (0.83, 0.81, 0.74)],
        0.002,
    )
    faces = {"y-": back, "z+": paper}
    return box(
        centre,
        size,
        plain(*colour),
        turn=(0, -lean_deg, 0),
        hide="z- y+",
        special=faces,
    )


def _book_row(
    x0: float,
    x1: float,
    z: float,
    depth: float,
    tall: float,
    rng: np.random.Generator,
) -> list[Solid]:
    """Upright books from x0 towards x1 on a board at height z; the last one may lean."""
    books = []
    x = x0
    while True:
        thick = rng.uniform(0.02, 0.05)
        high = rng.uniform(0.68, 0.95) * tall
        deep = rng.uniform(0.62, 0.85) * depth
        if x + thick > x1:
            return books
        books.append(
            _book(
                (x + thick / 2, -0.5 * depth + 0.02 + deep / 2, z + high / 2),
                (thick, deep, high),
                rng,
            )
        )
        x += thick + rng.uniform(0.0005, 0.002)
        if x1 - x > 0.12 and rng.uniform() < 0.09:
            lean = 14.0
            thick = 0.03
            high = 0.7 * tall
            c = np.cos(np.radians(lean))
            s = np.sin(np.radians(lean))
            centre = (x + 0.5 * (high * s + thick * c) + 0.002, 0, z + 0.5 * (high * c + thick * s))
            books.append(_book(centre, (thick, 0.65 * depth, high), rng, lean))
            x += high * s + thick * c + 0.006


def bookshelf(
    rng: np.random.Generator,
    width: float = 1.6,
    height: float = 2.0,
    depth: float = 0.28,
) -> list[Solid]:
    """Two columns of five cells with books and a few other objects."""
    board = drawn(0.005, draw.wood, _OAK)
    upright = drawn(0.005, draw.wood, _OAK, "v")
    back = drawn(0.008, draw.wood, (0.66, 0.49, 0.32), "v")
    b = 0.022
    solids: list[Solid] = [
        box(
            (0, depth / 2 - 0.006, height / 2),
            (width, 0.012, height),
            back,
            hide="y+ x- x+ z- z+",
        ),
        box(
            (0, 0, height - b / 2),
            (width, depth, b),
            board,
            hide="y+",
        ),
    ]
    for x in (-(width - b) / 2, 0.0, (width - b) / 2):
        solids.append(
            box(
                (x, 0, (height - b) / 2),
                (b, depth, height - b),
                upright,
                hide="y+ z- z+",
            )
        )
    cell = (height - b - 0.06) / 5
    for row, (col, x0) in product(range(5), enumerate((-width / 2 + b, b / 2))):
        x1 = x0 + width / 2 - 1.5 * b
        z = 0.06 + row * cell
        solids.append(
            box(
                ((x0 + x1) / 2, 0, z - b / 2),
                (x1 - x0, depth, b),
                board,
                hide="y+ x- x+",
            )
        )
        first = x0 + 0.004
        last = x1
        left_objects = []
        right_objects = []
        if (col, row) == (0, 3):
            first = x0 + 0.34
            left_objects = _vase(x0 + 0.16, z)
        elif (col, row) == (1, 1):
            last = x0 + 0.3
            right_objects = [_photo((x1 - 0.2, -0.02, z + 0.12))]
        elif (col, row) == (1, 4):
            first = x0 + 0.4
            last = x1 - 0.05
            left_objects = _crate(x0 + 0.2, z)
        else:
            last = x1 - rng.uniform(0.0, 0.16)
        solids += [*left_objects, *_book_row(first, last, z, depth, cell - b, rng), *right_objects]
    return solids


def _vase(x: float, z: float) -> list[Solid]:
    glaze = drawn(
        0.003,
        draw.speckled,
        (0.30, 0.48, 0.62),
        (0.85, 0.88, 0.9),
        0.006,
    )
    return [
        cone(
            (x, 0, z),
            0.1,
            (0.045, 0.085),
            glaze,
            hide="bottom top",
        ),
        cone(
            (x, 0, z + 0.1),
            0.12,
            (0.085, 0.03),
            glaze,
            hide="bottom",
        ),
    ]


def _photo(centre: Vector) -> Solid:
    dark = (0.15, 0.13, 0.12)
    photo = drawn(
        0.0015,
        draw.framed,
        partial(draw.landscape, sunset=True),
        dark,
        0.015,
        0.015,
    )
    return box(
        centre,
        (0.3, 0.02, 0.23),
        plain(*dark),
        turn=(0, 0, -10),
        special={"y-": photo},
    )


def _crate(x: float, z: float) -> list[Solid]:
    weave = drawn(
        0.003,
        draw.stripes,
        [(0.74, 0.6, 0.4), (0.6, 0.46, 0.28)],
        0.015,
        "v",
    )
    words = ["tape", "string", "bulbs"]
    colours = ((0.93, 0.9, 0.82), (0.2, 0.2, 0.2), (0.6, 0.2, 0.15))
    label = drawn(0.0015, draw.text_poster, "TOOLS", words, *colours)
    white = plain(0.9, 0.9, 0.85)
    return [
        box(
            (x, 0.01, z + 0.1),
            (0.34, 0.22, 0.2),
            weave,
            hide="z-",
        ),
        box(
            (x, -0.102, z + 0.11),
            (0.12, 0.004, 0.1),
            white,
            hide="y+",
            special={"y-": label},
        ),
    ]


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
        draw.speckled,
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
        green = drawn(0.004, draw.leaf, (0.22 * tone, 0.46 * tone, 0.18 * tone))
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
    cloth = drawn(0.005, draw.fabric, colour, contrast=0.12)
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


def coffee_table() -> list[Solid]:
    """A low round table on three splayed legs."""
    top = drawn(0.0025, draw.wood, _WALNUT)
    side = drawn(0.006, draw.wood, _WALNUT)
    leg = drawn(0.006, draw.wood, _WALNUT, "v")
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


def radiator(width: float = 1.2) -> list[Solid]:
    """A ribbed radiator."""
    n = round(width / 0.06)
    ribs = [
        cone(
            ((k + 0.5) * width / n - width / 2, 0, 0.14),
            0.56,
            (0.025, 0.025),
            WHITE,
        )
        for k in range(n)
    ]
    return [
        *ribs,
        *(box((0, 0.01, z), (width, 0.04, 0.05), WHITE, hide="x- x+") for z in (0.2, 0.64)),
    ]


def picture(
    width: float,
    height: float,
    paint: Paint,
    depth: float = 0.025,
    edge=(0.2, 0.17, 0.15),
) -> list[Solid]:
    """A flat picture whose back touches the wall at its origin."""
    return [
        box(
            (0, -depth / 2, 0),
            (width, depth, height),
            plain(*edge),
            hide="y+",
            special={"y-": paint},
        )
    ]


def mug(text: str, colour: Colour, ink: Colour) -> list[Solid]:
    """A cup of coffee with a handle."""
    print_ = drawn(0.0012, draw.mug, text, colour, ink)
    glaze = plain(*colour, texel_m=0.008)
    coffee = plain(0.16, 0.09, 0.05, texel_m=0.008)
    return [
        cone(
            (0, 0, 0),
            0.095,
            (0.038, 0.041),
            print_,
            hide="bottom",
            special={"top": coffee},
        ),
        rod((0.035, 0, 0.075), (0.07, 0, 0.072), 0.006, glaze),
        rod((0.07, 0, 0.078), (0.068, 0, 0.024), 0.006, glaze),
        rod((0.035, 0, 0.02), (0.07, 0, 0.028), 0.006, glaze),
    ]


def fruit_bowl(rng: np.random.Generator) -> list[Solid]:
    """A wide bowl filled with oranges and apples."""
    glaze = drawn(
        0.003,
        draw.speckled,
        (0.90, 0.88, 0.82),
        (0.45, 0.4, 0.38),
        0.005,
        0.08,
    )
    solids: list[Solid] = [
        cone(
            (0, 0, 0),
            0.015,
            (0.06, 0.06),
            glaze,
            hide="bottom top",
        ),
        cone(
            (0, 0, 0.012),
            0.075,
            (0.065, 0.15),
            glaze,
            hide="bottom",
        ),
    ]
    skins = [
        drawn(
            0.002,
            draw.speckled,
            (0.95, 0.55, 0.12),
            (0.85, 0.43, 0.08),
            0.003,
            0.2,
        ),
        drawn(
            0.002,
            draw.speckled,
            (0.72, 0.13, 0.12),
            (0.86, 0.55, 0.25),
            0.012,
            0.15,
        ),
        drawn(
            0.002,
            draw.speckled,
            (0.62, 0.72, 0.22),
            (0.72, 0.78, 0.4),
            0.006,
            0.15,
        ),
    ]
    for k in range(6):
        a = 2 * np.pi * k / 5
        at = (0.082 * np.cos(a), 0.082 * np.sin(a), 0.105) if k < 5 else (0.0, 0.0, 0.15)
        size = rng.uniform(0.036, 0.042)
        solids.append(
            ball(
                at,
                (size, size, 0.93 * size),
                skins[k % 3],
                turn=(0, rng.uniform(-20, 20), 0),
            )
        )
    return solids


def globe() -> list[Solid]:
    """A globe on a stand."""
    metal = plain(0.55, 0.42, 0.2, texel_m=0.01)
    tilt = np.radians(23)
    axis = np.array([np.sin(tilt), 0, np.cos(tilt)]) * 0.155
    centre = np.array([0, 0, 0.235])
    return [
        cone(
            (0, 0, 0),
            0.02,
            (0.085, 0.07),
            metal,
            hide="bottom",
        ),
        cone(
            (0, 0, 0.02),
            0.08,
            (0.012, 0.012),
            metal,
            hide="bottom top",
        ),
        ball(
            centre,
            0.14,
            drawn(0.002, draw.globe),
            turn=(0, 23, 0),
        ),
        rod(centre - axis, centre + axis, 0.006, metal),
    ]


def book_stack(rng: np.random.Generator) -> list[Solid]:
    """A stack of four books, each rotated a little; the cover of the top one is visible."""
    light = (0.95, 0.92, 0.82)
    dark = (0.2, 0.15, 0.1)
    pages = drawn(
        0.002,
        draw.stripes,
        [(0.93, 0.91, 0.84), (0.82, 0.8, 0.73)],
        0.003,
        "v",
    )
    books = (
        ("ATLAS", (0.14, 0.27, 0.44), light),
        ("OPTICS", (0.56, 0.16, 0.14), light),
        ("VOXELS", (0.85, 0.7, 0.3), dark),
        ("GAUSS", (0.18, 0.4, 0.34), light),
    )
    solids = []
    z = 0.0
    for k, book in enumerate(books):
        thick = rng.uniform(0.022, 0.04)
        front = drawn(0.0015, draw.cover, *book)
        faces = {
            "y-": drawn(0.0015, draw.lying_spine, *book),
            "x+": pages,
            "x-": pages,
            "y+": pages,
        }
        size = (0.24 - 0.015 * k, 0.17 - 0.01 * k, thick)
        turn = (rng.uniform(-14, 14), 0, 0)
        solids.append(
            box(
                (0, 0, z + thick / 2),
                size,
                front,
                turn=turn,
                hide="z-",
                special=faces,
            )
        )
        z += thick
    return solids


def open_book() -> list[Solid]:
    """Two facing pages."""
    solids = []
    size = (0.166, 0.23, 0.016)
    paper = plain(0.9, 0.88, 0.8)
    for side, heading in ((-1, "CHAPTER 3"), (1, "EQUATION 9")):
        page = {"z+": drawn(0.0012, draw.print_page, heading)}
        solids.append(
            box(
                (side * 0.082, 0, 0.012),
                size,
                paper,
                turn=(0, side * 2.5, 0),
                special=page,
            )
        )
    return solids


def laptop() -> list[Solid]:
    """An open laptop."""
    shell = plain(0.62, 0.63, 0.66)
    keys = drawn(0.0015, draw.keyboard)
    display = drawn(0.0012, draw.screen)
    return [
        box(
            (0, 0, 0.009),
            (0.34, 0.24, 0.018),
            shell,
            hide="z-",
            special={"z+": keys},
        ),
        box(
            (0, 0.155, 0.125),
            (0.34, 0.01, 0.23),
            shell,
            turn=(0, 0, -15),
            special={"y-": display},
        ),
    ]


def carton(size: tuple[float, float, float], text: str) -> list[Solid]:
    """A cardboard box."""
    side = drawn(0.002, draw.cardboard, text)
    lid = drawn(0.003, draw.cardboard, "")
    return [
        box(
            (0, 0, size[2] / 2),
            size,
            side,
            hide="z-",
            special={"z+": lid},
        )
    ]


def toy_blocks() -> list[Solid]:
    """Three wooden cubes with letters, one on top of two."""
    size = (0.07, 0.07, 0.07)
    solids = []
    for letter, x, y, z, turn, colour in (
        ("A", -0.04, 0.0, 0.0, 12, (0.8, 0.25, 0.2)),
        ("B", 0.045, 0.015, 0.0, -18, (0.2, 0.45, 0.7)),
        ("C", 0.0, 0.005, 0.07, 5, (0.85, 0.65, 0.15)),
    ):
        face = drawn(0.0015, draw.letter, letter, colour)
        covered_faces = "z-" if z == 0 else ""
        solids.append(
            box(
                (x, y, z + 0.035),
                size,
                face,
                turn=(turn, 0, 0),
                hide=covered_faces,
            )
        )
    return solids


def beach_ball(radius: float = 0.15) -> list[Solid]:
    """A ball with coloured gores."""
    white = (0.95, 0.95, 0.92)
    gores = [(0.85, 0.2, 0.18), white, (0.15, 0.45, 0.75), white, (0.95, 0.75, 0.15), white]
    return [
        ball(
            (0, 0, radius),
            radius,
            drawn(0.003, draw.ball, gores),
            turn=(30, 35, 20),
        )
    ]
