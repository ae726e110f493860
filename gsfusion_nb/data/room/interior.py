"""The arrangement of the room: walls, openings, furniture and objects as one list of solids in the
world frame.

World frame: z up, origin on the floor in the middle of the room; x east, y north; metres. The room
is 5 x 4 x 2.6.
"""

import functools
from functools import partial

import numpy as np

from . import books, fittings, furniture, materials, small_things
from . import drawings as draw
from .painted import ball, box, cone, drawn, placed, plain
from .solids import BOX_FACES, SIZE_M, Solid, Vector

SHELL_SOLIDS = 6
"""Number of slabs that make floor, walls and ceiling."""

_SHELL_M = 1.0
_EAST = 0.5 * SIZE_M[0]
_NORTH = 0.5 * SIZE_M[1]
_WEST = -_EAST
_SOUTH = -_NORTH


MOVED = ("none", "chair")
"""What can stand elsewhere than in the room as it is."""

_CHAIR = ((1.58, -0.67, 0.0), 186)
_CHAIR_MOVED = ((0.45, -0.55, 0.0), 140)
"""Place of the yellow chair, and its rotation about z in degrees: as it is, and moved."""


def interior(seed: int, moved: str = "none") -> list[Solid]:
    """Every solid of the room; ``seed`` varies books, leaves and fruit, ``moved`` is one of
    ``MOVED``."""
    rng = np.random.default_rng([seed, 1])
    return [
        *_shell(),
        *_trim(),
        *_window_side(),
        *_sofa_side(),
        *_table_side(rng, _CHAIR_MOVED if moved == "chair" else _CHAIR),
        *_shelf_side(rng),
    ]


@functools.lru_cache(maxsize=4)
def furnishing(seed: int, moved: str = "none") -> tuple[Solid, ...]:
    """Every solid except floor, walls and ceiling (which ``interior`` lists first)."""
    return tuple(interior(seed, moved)[SHELL_SOLIDS:])


def _arranged(*pieces: tuple[list[Solid], Vector, int]) -> list[Solid]:
    """Pieces of furniture at their places, each with its rotation about z in degrees."""
    return [solid for piece, at, yaw_deg in pieces for solid in placed(piece, at, yaw_deg)]


def _shell() -> list[Solid]:
    """Six slabs whose inner faces are floor, walls and ceiling."""
    w, d, h = SIZE_M
    s = _SHELL_M
    brick = drawn(0.004, materials.brick, (0.62, 0.33, 0.25))
    paper = drawn(
        0.004,
        materials.wallpaper,
        (0.80, 0.80, 0.72),
        (0.68, 0.71, 0.62),
    )
    north = drawn(0.012, materials.paint, (0.82, 0.86, 0.87))
    south = drawn(0.012, materials.paint, (0.90, 0.86, 0.79))
    floor = drawn(0.0028, materials.planks, (0.64, 0.47, 0.31))
    white = drawn(0.02, materials.paint, (0.95, 0.95, 0.94), 0.0, 0.004)
    slabs = [
        ((0, 0, -s / 2), (w, d, s), "z+", floor),
        ((0, 0, h + s / 2), (w, d, s), "z-", white),
        ((-w / 2 - s / 2, 0, h / 2), (s, d, h), "x+", paper),
        ((w / 2 + s / 2, 0, h / 2), (s, d, h), "x-", brick),
        ((0, -d / 2 - s / 2, h / 2), (w, s, h), "y+", south),
        ((0, d / 2 + s / 2, h / 2), (w, s, h), "y-", north),
    ]
    return [
        box(centre, size, paint, hide=" ".join({*BOX_FACES} - {face}))
        for centre, size, face, paint in slabs
    ]


def _trim() -> list[Solid]:
    """Skirting boards, switch, sockets."""
    w, d, _ = SIZE_M
    white = plain(0.92, 0.91, 0.88)
    grey = plain(0.8, 0.8, 0.78)
    switch: list[Solid] = [
        box(
            (0, -0.006, 0),
            (0.085, 0.012, 0.085),
            white,
            hide="y+",
        ),
        box(
            (0, -0.014, 0),
            (0.05, 0.008, 0.05),
            grey,
            hide="y+",
        ),
    ]
    return [
        box(
            (0, d / 2 - 0.008, 0.045),
            (w, 0.016, 0.09),
            white,
            hide="z- y+ x- x+",
        ),
        box(
            (0.68, -d / 2 + 0.008, 0.045),
            (3.64, 0.016, 0.09),
            white,
            hide="z- y- x+",
        ),
        box(
            (-2.33, -d / 2 + 0.008, 0.045),
            (0.34, 0.016, 0.09),
            white,
            hide="z- y- x-",
        ),
        box(
            (-w / 2 + 0.008, 0, 0.045),
            (0.016, d, 0.09),
            white,
            hide="z- x- y- y+",
        ),
        box(
            (w / 2 - 0.008, 0, 0.045),
            (0.016, d, 0.09),
            white,
            hide="z- x+ y- y+",
        ),
        *_arranged(
            (switch, (-0.92, _SOUTH, 1.1), 180),
            (switch, (0.05, _SOUTH, 0.3), 180),
        ),
    ]


def _window_side() -> list[Solid]:
    """North wall: window with sill and curtains, radiator, floor lamp, pictures in the corner."""
    y = _NORTH
    x = 0.2
    white = plain(0.94, 0.94, 0.92)
    wide = 1.7
    low = 0.95
    high = 2.2
    mid = (low + high) / 2
    tall = high - low
    view = {"y-": drawn(0.004, draw.landscape, glow=0.98)}
    solids = [
        box(
            (x, y - 0.006, mid),
            (wide, 0.012, tall),
            white,
            hide="y+ x- x+ z- z+",
            special=view,
        )
    ]
    for z in (low, high):
        solids.append(
            box(
                (x, y - 0.025, z),
                (wide + 0.1, 0.05, 0.06),
                white,
                hide="y+",
            )
        )
    for dx, thick in ((-wide / 2, 0.06), (0.0, 0.05), (wide / 2, 0.06)):
        solids.append(
            box(
                (x + dx, y - 0.022, mid),
                (thick, 0.044, tall),
                white,
                hide="y+ z- z+",
            )
        )
    solids.append(
        box(
            (x, y - 0.02, low + 0.85),
            (wide, 0.035, 0.035),
            white,
            hide="y+ x- x+",
        )
    )
    solids.append(
        box(
            (x, y - 0.09, low - 0.045),
            (wide + 0.24, 0.18, 0.03),
            white,
            hide="y+",
        )
    )
    solids += placed(fittings.radiator(1.3), (x, y - 0.07, 0))
    solids.append(
        box(
            (x, y - 0.08, 2.36),
            (2.9, 0.025, 0.025),
            plain(0.3, 0.25, 0.2),
        )
    )
    for dx in (-1.15, 1.15):
        solids += placed(
            fittings.curtain(0.5, 2.3, (0.78, 0.70, 0.58)),
            (x + dx, y - 0.08, 0.05),
        )
    for dx, tall in ((-0.45, 0.16), (0.55, 0.12)):
        pot = drawn(
            0.003,
            materials.speckled,
            (0.75, 0.75, 0.72),
            (0.5, 0.55, 0.6),
            0.008,
        )
        green = drawn(
            0.003,
            materials.speckled,
            (0.3, 0.5, 0.25),
            (0.75, 0.8, 0.6),
            0.006,
            0.1,
        )
        parts: list[Solid] = [
            cone(
                (0, 0, 0),
                0.09,
                (0.035, 0.05),
                pot,
                hide="bottom",
                special={"top": fittings.SOIL},
            ),
            ball(
                (0, 0, 0.09 + 0.7 * tall / 2),
                (0.04, 0.04, tall / 2),
                green,
            ),
        ]
        solids += placed(parts, (x + dx, y - 0.095, low - 0.03))
    return solids + placed(fittings.floor_lamp(), (-2.1, 1.62, 0))


def _sofa_side() -> list[Solid]:
    """West wall: sofa under two pictures, rug, coffee table, toys."""
    x = _WEST
    z = 0.427
    view = drawn(
        0.002,
        draw.framed,
        draw.landscape,
        (0.28, 0.2, 0.14),
        0.03,
        0.04,
    )
    lines = [
        "every pixel is a ray",
        "every voxel an average",
        "every splat a guess",
        "keep what is seen twice",
    ]
    colours = ((0.95, 0.93, 0.86), (0.13, 0.15, 0.2), (0.75, 0.25, 0.15))
    text = drawn(0.0018, draw.text_poster, "MAP THE ROOM", [*lines, "forget the rest"], *colours)
    weave = drawn(
        0.004,
        materials.rug,
        ((0.80, 0.76, 0.66), (0.24, 0.32, 0.44), (0.68, 0.30, 0.22)),
    )
    mug = small_things.mug("HELLO", (0.9, 0.88, 0.84), (0.2, 0.35, 0.5))
    wicker = drawn(
        0.004,
        materials.stripes,
        [(0.75, 0.6, 0.42), (0.62, 0.47, 0.3)],
        0.02,
        "v",
    )
    vase = drawn(
        0.003,
        materials.stripes,
        [(0.9, 0.88, 0.82), (0.25, 0.35, 0.5)],
        0.02,
        "v",
    )
    return [
        *_arranged(
            (furniture.sofa(), (x + 0.48, 0.2, 0), 90),
            (small_things.picture(1.0, 0.7, view), (x, 0.55, 1.6), 90),
            (small_things.picture(0.55, 0.8, text), (x, -0.42, 1.6), 90),
        ),
        box(
            (-0.85, 0.2, 0.006),
            (1.7, 2.3, 0.012),
            weave,
            hide="z-",
        ),
        *_arranged(
            (furniture.coffee_table(), (-0.95, 0.25, 0.012), 0),
            (books.open_book(), (-0.9, 0.08, z), 70),
            (mug, (-1.08, 0.38, z), 30),
            (small_things.toy_blocks(), (-0.35, -0.6, 0.012), 100),
            (small_things.beach_ball(), (-0.75, -1.3, 0), 20),
            ([cone((0, 0, 0), 0.5, (0.16, 0.2), wicker, hide="bottom")], (x + 0.3, -1.05, 0), 0),
            ([cone((0, 0, 0), 0.22, (0.05, 0.08), vase, hide="bottom")], (x + 0.3, -1.05, 0.5), 0),
            (
                [cone((0, 0, 0.22), 0.05, (0.08, 0.045), vase, hide="bottom")],
                (x + 0.3, -1.05, 0.5),
                0,
            ),
        ),
    ]


def _table_side(rng: np.random.Generator, chair: tuple[Vector, int]) -> list[Solid]:
    """East, in front of the brick wall: table with objects on it, chairs, lamp, pictures, plant."""
    x = _EAST
    tx = 1.5
    ty = 0.35
    z = 0.74
    bowl = small_things.fruit_bowl(rng)
    pile = books.book_stack(rng)
    mug = small_things.mug("COFFEE", (0.2, 0.3, 0.42), (0.93, 0.9, 0.82))
    circles = drawn(
        0.002,
        draw.framed,
        draw.circles_poster,
        (0.1, 0.1, 0.1),
        0.02,
        0.03,
    )
    sunset = drawn(
        0.002,
        draw.framed,
        partial(draw.landscape, sunset=True),
        (0.85, 0.8, 0.7),
        0.03,
        0.0,
    )
    return _arranged(
        (furniture.table(), (tx, ty, 0), 90),
        (furniture.chair((0.72, 0.30, 0.24)), (tx - 0.62, ty + 0.32, 0), 80),
        (furniture.chair((0.25, 0.42, 0.5)), (tx - 0.66, ty - 0.36, 0), 105),
        (furniture.chair((0.80, 0.68, 0.35)), *chair),
        (small_things.laptop(), (tx - 0.12, ty - 0.32, z), -84),
        (bowl, (tx + 0.02, ty + 0.12, z), 0),
        (small_things.globe(), (tx + 0.22, ty + 0.50, z), 200),
        (pile, (tx - 0.2, ty + 0.5, z), -75),
        (mug, (tx + 0.24, ty - 0.25, z), 200),
        (fittings.pendant(), (tx, ty, SIZE_M[2]), 0),
        (small_things.picture(0.62, 0.82, circles), (x, 0.75, 1.6), -90),
        (small_things.picture(0.7, 0.5, sunset), (x, -0.2, 1.62), -90),
        (fittings.plant(rng), (2.12, 1.5, 0), 0),
        (small_things.carton((0.5, 0.4, 0.36), "FRAGILE"), (2.18, -1.72, 0), -75),
        (small_things.carton((0.36, 0.3, 0.26), "BOOKS"), (2.2, -1.7, 0.36), -60),
    )


def _shelf_side(rng: np.random.Generator) -> list[Solid]:
    """South wall: bookshelf, door, clock, eye chart."""
    white = plain(0.9, 0.89, 0.85)
    brass = plain(0.72, 0.58, 0.3, texel_m=0.01)
    door: list[Solid] = [
        box(
            (0, -0.015, 1.02),
            (0.84, 0.03, 2.04),
            white,
            hide="y+ z-",
            special={"y-": drawn(0.004, draw.door)},
        ),
        *(box((dx, -0.025, 1.04), (0.09, 0.05, 2.08), white, hide="y+ z-") for dx in (-0.46, 0.46)),
        box(
            (0, -0.025, 2.12),
            (1.01, 0.05, 0.09),
            white,
            hide="y+",
        ),
        cone(
            (0.35, -0.03, 1.0),
            0.05,
            (0.012, 0.012),
            brass,
            turn=(0, 0, 90),
            hide="bottom",
        ),
        ball((0.35, -0.085, 1.0), 0.028, brass),
    ]
    chart = small_things.picture(
        0.5,
        0.72,
        drawn(0.0018, draw.eye_chart),
        0.012,
        (0.9, 0.9, 0.88),
    )
    dial = {"top": drawn(0.0018, draw.clock)}
    rim = plain(0.12, 0.12, 0.13)
    clock = cone(
        (0, 0, 0),
        0.035,
        (0.16, 0.16),
        rim,
        turn=(0, 0, 90),
        hide="bottom",
        special=dial,
    )
    return _arranged(
        (books.bookshelf(rng), (0.98, _SOUTH + 0.141, 0), 180),
        (door, (-1.65, _SOUTH, 0), 180),
        (chart, (-0.42, _SOUTH, 1.55), 180),
        ([clock], (-0.42, _SOUTH, 2.2), 180),
    )
