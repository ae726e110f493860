"""The arrangement of the room: walls, openings, furniture and objects as one list of solids in the world frame.

World frame: z up, origin on the floor in the middle of the room; x east, y north; metres. The room is 5 x 4 x 2.6.
"""

import functools

import numpy as np

from . import drawings, small_objects, textures
from . import furniture as f
from .build import ball, box, cone, drawn, glowing, placed, plain
from .solids import Box, Paint, Solid

SIZE_M = (5.0, 4.0, 2.6)
SHELL_SOLIDS = 6
"""Number of slabs that make floor, walls and ceiling."""

_SHELL_M = 1.0


def interior(seed: int) -> list[Solid]:
    """Every solid of the room; ``seed`` varies books, leaves and fruit."""
    rng = np.random.default_rng([seed, 1])
    return [*_shell(), *_trim(), *_window_side(), *_sofa_side(), *_table_side(rng), *_shelf_side(rng)]


@functools.lru_cache(maxsize=4)
def furnishing(seed: int) -> tuple[Solid, ...]:
    """Every solid except floor, walls and ceiling (which ``interior`` lists first)."""
    return tuple(interior(seed)[SHELL_SOLIDS:])


def _shell() -> list[Solid]:
    """Six slabs whose inner faces are floor, walls and ceiling."""
    w, d, h = SIZE_M
    s = _SHELL_M
    brick = drawn(textures.brick((0.62, 0.33, 0.25)), 0.004)
    paper = drawn(textures.wallpaper((0.80, 0.80, 0.72), (0.68, 0.71, 0.62)), 0.004)
    north = drawn(textures.paint((0.82, 0.86, 0.87)), 0.012)
    south = drawn(textures.paint((0.90, 0.86, 0.79)), 0.012)
    floor = drawn(textures.planks((0.64, 0.47, 0.31)), 0.0028, gloss=0.12)
    white = drawn(textures.paint((0.95, 0.95, 0.94), 0.0, 0.004), 0.02)
    slabs: list[tuple[tuple, tuple, str, Paint]] = [
        ((0, 0, -s / 2), (w, d, s), "z+", floor),
        ((0, 0, h + s / 2), (w, d, s), "z-", white),
        ((-w / 2 - s / 2, 0, h / 2), (s, d, h), "x+", paper),
        ((w / 2 + s / 2, 0, h / 2), (s, d, h), "x-", brick),
        ((0, -d / 2 - s / 2, h / 2), (w, s, h), "y+", south),
        ((0, d / 2 + s / 2, h / 2), (w, s, h), "y-", north),
    ]
    solids: list[Solid] = []
    for centre, size, face, paint in slabs:
        others = " ".join(name for name in Box.faces if name != face)  # pyright: ignore[reportGeneralTypeIssues]
        solids.append(box(centre, size, paint, hide=others))
    return solids


def _trim() -> list[Solid]:
    """Skirting boards, switch, sockets."""
    w, d, _ = SIZE_M
    white = plain(0.92, 0.91, 0.88)
    solids: list[Solid] = [
        box((0, d / 2 - 0.008, 0.045), (w, 0.016, 0.09), white, hide="z- y+ x- x+"),
        box((0.68, -d / 2 + 0.008, 0.045), (3.64, 0.016, 0.09), white, hide="z- y- x+"),
        box((-2.33, -d / 2 + 0.008, 0.045), (0.34, 0.016, 0.09), white, hide="z- y- x-"),
        box((-w / 2 + 0.008, 0, 0.045), (0.016, d, 0.09), white, hide="z- x- y- y+"),
        box((w / 2 - 0.008, 0, 0.045), (0.016, d, 0.09), white, hide="z- x+ y- y+"),
    ]
    for x, z in ((-0.92, 1.1), (0.05, 0.3)):
        plate = box((0, -0.006, 0), (0.085, 0.012, 0.085), white, hide="y+")
        button = box((0, -0.014, 0), (0.05, 0.008, 0.05), plain(0.8, 0.8, 0.78), hide="y+")
        solids += placed([plate, button], (x, -d / 2, z), 180)
    return solids


def _window_side() -> list[Solid]:
    """North wall: window with sill and curtains, radiator, floor lamp, pictures in the corner."""
    y, x, white = SIZE_M[1] / 2, 0.2, plain(0.94, 0.94, 0.92)
    wide, low, high = 1.7, 0.95, 2.2
    view = glowing((1, 1, 1), 0.98, drawings.landscape(), 0.004)
    mid = (low + high) / 2
    solids: list[Solid] = [
        box((x, y - 0.006, mid), (wide, 0.012, high - low), white, hide="y+ x- x+ z- z+", special={"y-": view})
    ]
    for z in (low, high):
        solids.append(box((x, y - 0.025, z), (wide + 0.1, 0.05, 0.06), white, hide="y+"))
    for dx, thick in ((-wide / 2, 0.06), (0.0, 0.05), (wide / 2, 0.06)):
        solids.append(box((x + dx, y - 0.022, mid), (thick, 0.044, high - low), white, hide="y+ z- z+"))
    solids.append(box((x, y - 0.02, low + 0.85), (wide, 0.035, 0.035), white, hide="y+ x- x+"))
    solids.append(box((x, y - 0.09, low - 0.045), (wide + 0.24, 0.18, 0.03), white, hide="y+"))
    solids += placed(f.radiator(1.3), (x, y - 0.07, 0))
    rail = plain(0.3, 0.25, 0.2)
    solids.append(box((x, y - 0.08, 2.36), (2.9, 0.025, 0.025), rail))
    for dx in (-1.15, 1.15):
        solids += placed(f.curtain(0.5, 2.3, (0.78, 0.70, 0.58)), (x + dx, y - 0.08, 0.05))
    for dx, tall in ((-0.45, 0.16), (0.55, 0.12)):
        pot = drawn(textures.speckled((0.75, 0.75, 0.72), (0.5, 0.55, 0.6), 0.008), 0.003)
        at = (x + dx, y - 0.095, low - 0.03)
        solids += placed(
            [cone((0, 0, 0), 0.09, (0.035, 0.05), pot, hide="bottom", special={"top": plain(0.2, 0.14, 0.1)})], at
        )
        green = drawn(textures.speckled((0.3, 0.5, 0.25), (0.75, 0.8, 0.6), 0.006, 0.1), 0.003)
        solids += placed([ball((0, 0, 0.09 + 0.7 * tall / 2), (0.04, 0.04, tall / 2), green)], at)
    return solids + placed(f.floor_lamp(), (-2.1, 1.62, 0))


def _sofa_side() -> list[Solid]:
    """West wall: sofa under two pictures, rug, coffee table, toys."""
    x = -SIZE_M[0] / 2
    solids = placed(f.sofa(), (x + 0.48, 0.2, 0), 90)
    view = drawn(drawings.framed(drawings.landscape(), (0.28, 0.2, 0.14), frame_m=0.03, mat_m=0.04), 0.002)
    lines = [
        "every pixel is a ray",
        "every voxel an average",
        "every splat a guess",
        "keep what is seen twice",
        "forget the rest",
    ]
    text = drawn(
        drawings.text_poster("MAP THE ROOM", lines, (0.95, 0.93, 0.86), (0.13, 0.15, 0.2), (0.75, 0.25, 0.15)), 0.0018
    )
    solids += placed(f.picture(1.0, 0.7, view), (x, 0.55, 1.6), 90)
    solids += placed(f.picture(0.55, 0.8, text), (x, -0.42, 1.6), 90)
    weave = drawn(textures.rug(((0.80, 0.76, 0.66), (0.24, 0.32, 0.44), (0.68, 0.30, 0.22))), 0.004)
    solids.append(box((-0.85, 0.2, 0.006), (1.7, 2.3, 0.012), weave, turn=(0, 0, 0), hide="z-"))
    solids += placed(f.coffee_table(), (-0.95, 0.25, 0.012))
    z = 0.427
    solids += f.set_on(small_objects.open_book(), -0.9, 0.08, z, 70)
    solids += f.set_on(small_objects.mug("HELLO", (0.9, 0.88, 0.84), (0.2, 0.35, 0.5)), -1.08, 0.38, z, 30)
    solids += f.set_on(small_objects.toy_blocks(), -0.35, -0.6, 0.012, 100)
    solids += placed(small_objects.beach_ball(), (-0.75, -1.3, 0), 20)
    stand = cone(
        (0, 0, 0),
        0.5,
        (0.16, 0.2),
        drawn(textures.stripes([(0.75, 0.6, 0.42), (0.62, 0.47, 0.3)], 0.02, "v"), 0.004),
        hide="bottom",
    )
    solids += placed([stand], (x + 0.3, -1.05, 0))
    vase = drawn(textures.stripes([(0.9, 0.88, 0.82), (0.25, 0.35, 0.5)], 0.02, "v"), 0.003, gloss=0.5)
    return solids + placed(
        [
            cone((0, 0, 0), 0.22, (0.05, 0.08), vase, hide="bottom"),
            cone((0, 0, 0.22), 0.05, (0.08, 0.045), vase, hide="bottom"),
        ],
        (x + 0.3, -1.05, 0.5),
    )


def _table_side(rng: np.random.Generator) -> list[Solid]:
    """East, in front of the brick wall: table with objects on it, chairs, lamp, pictures, plant."""
    tx, ty = 1.5, 0.35
    solids = placed(f.table(), (tx, ty, 0), 90)
    solids += placed(f.chair((0.72, 0.30, 0.24)), (tx - 0.62, ty + 0.32, 0), 80)
    solids += placed(f.chair((0.25, 0.42, 0.5)), (tx - 0.66, ty - 0.36, 0), 105)
    solids += placed(f.chair((0.80, 0.68, 0.35)), (tx + 0.08, ty - 1.02, 0), 186)
    z = 0.74
    solids += f.set_on(small_objects.laptop(), tx - 0.12, ty - 0.32, z, -84)
    solids += f.set_on(small_objects.fruit_bowl(rng), tx + 0.02, ty + 0.12, z)
    solids += f.set_on(small_objects.globe(), tx + 0.22, ty + 0.50, z, 200)
    solids += f.set_on(small_objects.book_stack(rng), tx - 0.2, ty + 0.5, z, -75)
    solids += f.set_on(small_objects.mug("COFFEE", (0.2, 0.3, 0.42), (0.93, 0.9, 0.82)), tx + 0.24, ty - 0.25, z, 200)
    solids += placed(f.pendant(), (tx, ty, SIZE_M[2]))
    x = SIZE_M[0] / 2
    circles = drawn(drawings.framed(drawings.circles_poster(), (0.1, 0.1, 0.1), frame_m=0.02, mat_m=0.03), 0.002)
    sunset = drawn(drawings.framed(drawings.landscape(True), (0.85, 0.8, 0.7), frame_m=0.03, mat_m=0.0), 0.002)
    solids += placed(f.picture(0.62, 0.82, circles), (x, 0.75, 1.6), -90)
    solids += placed(f.picture(0.7, 0.5, sunset), (x, -0.2, 1.62), -90)
    solids += placed(f.plant(rng), (2.12, 1.5, 0), 0)
    solids += placed(small_objects.carton((0.5, 0.4, 0.36), "FRAGILE"), (2.18, -1.72, 0), -75)
    solids += placed(small_objects.carton((0.36, 0.3, 0.26), "BOOKS"), (2.2, -1.7, 0.36), -60)
    return solids


def _shelf_side(rng: np.random.Generator) -> list[Solid]:
    """South wall: bookshelf, door, clock, eye chart."""
    y = -SIZE_M[1] / 2
    solids = placed(f.bookshelf(rng), (0.98, y + 0.141, 0), 180)
    leaf = drawn(drawings.door(), 0.004)
    white = plain(0.9, 0.89, 0.85)
    parts: list[Solid] = [box((0, -0.015, 1.02), (0.84, 0.03, 2.04), white, hide="y+ z-", special={"y-": leaf})]
    for dx in (-0.46, 0.46):
        parts.append(box((dx, -0.025, 1.04), (0.09, 0.05, 2.08), white, hide="y+ z-"))
    parts.append(box((0, -0.025, 2.12), (1.01, 0.05, 0.09), white, hide="y+"))
    brass = plain(0.72, 0.58, 0.3, gloss=0.8, texel_m=0.01)
    parts.append(cone((0.35, -0.03, 1.0), 0.05, (0.012, 0.012), brass, turn=(0, 0, 90), hide="bottom"))
    parts.append(ball((0.35, -0.085, 1.0), 0.028, brass))
    solids += placed(parts, (-1.65, y, 0), 180)
    chart = drawn(drawings.eye_chart(), 0.0018)
    solids += placed(f.picture(0.5, 0.72, chart, 0.012, (0.9, 0.9, 0.88)), (-0.42, y, 1.55), 180)
    dial, rim = drawn(drawings.clock(), 0.0018), plain(0.12, 0.12, 0.13)
    clock = cone((0, 0, 0), 0.035, (0.16, 0.16), rim, turn=(0, 0, 90), hide="bottom", special={"top": dial})
    return solids + placed([clock], (-0.42, y, 2.2), 180)
