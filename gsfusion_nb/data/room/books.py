"""The bookshelf with what stands in it, piles of books and an open one, as solids around the point
they stand on, front towards -y."""

from functools import partial
from itertools import product

import numpy as np

from . import book_drawings, materials
from . import drawings as draw
from .furniture import OAK
from .painted import box, cone, drawn, plain
from .solids import Solid, Vector

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
        book_drawings.spine,
        _TITLES[rng.integers(len(_TITLES))],
        colour,
        ink,
    )
    paper = drawn(
        0.004,
        materials.stripes,
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
    board = drawn(0.005, materials.wood, OAK)
    upright = drawn(0.005, materials.wood, OAK, "v")
    back = drawn(0.008, materials.wood, (0.66, 0.49, 0.32), "v")
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
        materials.speckled,
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
        materials.stripes,
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


def book_stack(rng: np.random.Generator) -> list[Solid]:
    """A stack of four books, each rotated a little; the cover of the top one is visible."""
    light = (0.95, 0.92, 0.82)
    dark = (0.2, 0.15, 0.1)
    pages = drawn(
        0.002,
        materials.stripes,
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
        front = drawn(0.0015, book_drawings.cover, *book)
        faces = {
            "y-": drawn(0.0015, book_drawings.lying_spine, *book),
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
        page = {"z+": drawn(0.0012, book_drawings.print_page, heading)}
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
