"""Large furniture: each function returns one piece as solids around its own origin on the floor, front towards -y."""

import numpy as np

from . import drawings, textures
from .build import ball, box, cone, drawn, glowing, placed, plain, rod
from .solids import Solid

_OAK = (0.72, 0.53, 0.34)
_WALNUT = (0.45, 0.30, 0.20)
_WHITE = (0.93, 0.92, 0.89)


def sofa() -> list[Solid]:
    """Two seats, 1.9 m wide, 0.9 m deep, with loose cushions and three pillows."""
    cloth = drawn(textures.fabric((0.33, 0.46, 0.50)), 0.003)
    rough = drawn(textures.fabric((0.31, 0.43, 0.47)), 0.008)
    solids: list[Solid] = [
        box((0, 0.02, 0.24), (1.86, 0.82, 0.24), rough, radius=0.03, hide="y+"),
        box((0, 0.36, 0.55), (1.86, 0.2, 0.6), cloth, radius=0.06, hide="y+ z-"),
        box((-0.86, -0.02, 0.4), (0.2, 0.88, 0.5), cloth, radius=0.06, special={"y+": rough}),
        box((0.86, -0.02, 0.4), (0.2, 0.88, 0.5), cloth, radius=0.06, special={"y+": rough}),
    ]
    for x in (-0.375, 0.375):
        solids.append(box((x, -0.08, 0.42), (0.745, 0.7, 0.18), cloth, radius=0.05, hide="z-"))
        solids.append(box((x, 0.21, 0.68), (0.73, 0.18, 0.42), cloth, radius=0.07, turn=(0, 0, -12), hide="z-"))
    mustard = drawn(textures.fabric((0.83, 0.62, 0.22), contrast=0.14), 0.002)
    bands = drawn(
        textures.stripes([(0.85, 0.82, 0.74), (0.70, 0.28, 0.22), (0.85, 0.82, 0.74), (0.2, 0.25, 0.38)], 0.03), 0.002
    )
    word = drawn(drawings.lettered_cushion("HOME", (0.88, 0.86, 0.8), (0.25, 0.22, 0.3)), 0.0015)
    solids.append(box((-0.58, 0.03, 0.70), (0.4, 0.12, 0.4), mustard, radius=0.055, turn=(14, 0, -24)))
    solids.append(box((0.2, 0.04, 0.68), (0.42, 0.12, 0.34), bands, radius=0.055, turn=(-6, 0, -24)))
    solids.append(
        box((0.6, 0.02, 0.70), (0.4, 0.12, 0.4), mustard, radius=0.055, turn=(-16, 0, -22), special={"y-": word})
    )
    leg = plain(0.25, 0.17, 0.11)
    solids += [
        cone((x, y, 0), 0.13, (0.018, 0.028), leg, hide="bottom top") for x in (-0.84, 0.84) for y in (-0.32, 0.34)
    ]
    return solids


def table(width: float = 1.4, depth: float = 0.8, height: float = 0.74) -> list[Solid]:
    """A wooden table with tapered legs and an apron."""
    top = drawn(textures.wood(_OAK, "u"), 0.0025, gloss=0.25)
    side = drawn(textures.wood(_OAK, "u"), 0.006)
    solids: list[Solid] = [box((0, 0, height - 0.018), (width, depth, 0.036), side, radius=0.006, special={"z+": top})]
    x, y = 0.5 * width - 0.07, 0.5 * depth - 0.07
    solids += [
        cone((i * x, j * y, 0), height - 0.036, (0.02, 0.034), side, hide="bottom top")
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    z, h = height - 0.036 - 0.04, 0.08
    for s in (-1, 1):
        solids.append(box((0, s * y, z), (2 * x, 0.022, h), side, hide="x- x+ z+"))
        solids.append(box((s * x, 0, z), (0.022, 2 * y, h), side, hide="y- y+ z+"))
    return solids


def chair(seat: tuple[float, float, float]) -> list[Solid]:
    """A wooden chair with a padded seat; its front faces -y."""
    frame = drawn(textures.wood(_WALNUT, "v"), 0.006)
    slat = drawn(textures.wood(_WALNUT, "u"), 0.005)
    pad = drawn(textures.fabric(seat, contrast=0.15), 0.0025)
    solids: list[Solid] = [
        box((0, 0, 0.43), (0.42, 0.42, 0.03), slat),
        box((0, -0.01, 0.46), (0.39, 0.38, 0.045), pad, radius=0.02, hide="z-"),
    ]
    for x in (-0.18, 0.18):
        solids.append(cone((x, -0.18, 0), 0.42, (0.014, 0.02), frame, hide="bottom top"))
        solids.append(rod((x, 0.21, 0), (x, 0.18, 0.45), 0.018, frame, hide="bottom"))
        solids.append(rod((x, 0.18, 0.43), (x, 0.25, 0.9), 0.017, frame))
    for z, y in ((0.84, 0.24), (0.70, 0.22), (0.58, 0.20)):
        solids.append(box((0, y, z), (0.35, 0.018, 0.07), slat, turn=(0, 0, -8)))
    return solids


_TITLES = [
    "OCTREES", "LINEAR ALGEBRA", "OPTICS", "FIELD NOTES", "GEOMETRY", "RAYS", "KALMAN", "BIRDS", "JAZZ", "SPLINES",
    "COOKING", "ATLAS", "RUST", "NORDIC SEA", "CHESS", "TRAVELS", "POEMS", "VOXELS", "GARDENS", "DESIGN", "PRIMES",
    "MAPS", "THE HOUSE", "BRIDGES", "LIGHT", "SIGNALS", "NIGHT TRAIN", "ESSAYS", "GAUSS", "STATISTICS", "MOUNTAINS",
]  # fmt: skip
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
]  # fmt: skip


def _book(centre, size, rng: np.random.Generator, turn=(0.0, 0.0, 0.0)) -> Solid:
    colour = _CLOTHS[rng.integers(len(_CLOTHS))]
    ink = (0.95, 0.9, 0.75) if sum(colour) < 1.6 else (0.15, 0.12, 0.12)
    back = drawn(drawings.spine(_TITLES[rng.integers(len(_TITLES))], colour, ink), 0.0014)
    paper = drawn(textures.stripes([(0.93, 0.91, 0.84), (0.83, 0.81, 0.74)], 0.002), 0.004)
    return box(centre, size, plain(*colour), turn=turn, hide="z- y+", special={"y-": back, "z+": paper})


def _book_row(x0: float, x1: float, z: float, depth: float, tall: float, rng: np.random.Generator) -> list[Solid]:
    """Upright books from x0 towards x1 on a board at height z; the last one may lean."""
    books, x = [], x0
    while True:
        thick, high, deep = rng.uniform(0.02, 0.05), rng.uniform(0.68, 0.95) * tall, rng.uniform(0.62, 0.85) * depth
        if x + thick > x1:
            return books
        books.append(_book((x + thick / 2, -0.5 * depth + 0.02 + deep / 2, z + high / 2), (thick, deep, high), rng))
        x += thick + rng.uniform(0.0005, 0.002)
        if x1 - x > 0.12 and rng.uniform() < 0.09:
            lean, thick, high = 14.0, 0.03, 0.7 * tall
            c, s = np.cos(np.radians(lean)), np.sin(np.radians(lean))
            centre = (x + 0.5 * (high * s + thick * c) + 0.002, 0, z + 0.5 * (high * c + thick * s))
            books.append(_book(centre, (thick, 0.65 * depth, high), rng, (0, -lean, 0)))
            x += high * s + thick * c + 0.006


def bookshelf(rng: np.random.Generator, width: float = 1.6, height: float = 2.0, depth: float = 0.28) -> list[Solid]:
    """Two columns of five cells with books and a few other objects."""
    board = drawn(textures.wood(_OAK, "u"), 0.005)
    upright = drawn(textures.wood(_OAK, "v"), 0.005)
    b = 0.022
    solids: list[Solid] = [
        box(
            (0, depth / 2 - 0.006, height / 2),
            (width, 0.012, height),
            drawn(textures.wood((0.66, 0.49, 0.32), "v"), 0.008),
            hide="y+ x- x+ z- z+",
        ),
        box((0, 0, height - b / 2), (width, depth, b), board, hide="y+"),
    ]
    for x in (-(width - b) / 2, 0.0, (width - b) / 2):
        solids.append(box((x, 0, (height - b) / 2), (b, depth, height - b), upright, hide="y+ z- z+"))
    cell = (height - b - 0.06) / 5
    extras = {(0, 3): _vase_cell, (1, 1): _frame_cell, (1, 4): _crate_cell}
    for row in range(5):
        z = 0.06 + row * cell
        for col, x0 in enumerate((-width / 2 + b, b / 2)):
            x1 = x0 + width / 2 - 1.5 * b
            solids.append(box(((x0 + x1) / 2, 0, z - b / 2), (x1 - x0, depth, b), board, hide="y+ x- x+"))
            if (col, row) in extras:
                solids += extras[col, row](x0, x1, z, depth, cell - b, rng)
            else:
                solids += _book_row(x0 + 0.004, x1 - rng.uniform(0.0, 0.16), z, depth, cell - b, rng)
    return solids


def _vase_cell(x0, x1, z, depth, tall, rng) -> list[Solid]:
    glaze = drawn(textures.speckled((0.30, 0.48, 0.62), (0.85, 0.88, 0.9), 0.006), 0.003, gloss=0.5)
    x = x0 + 0.16
    vase = [
        cone((x, 0, z), 0.1, (0.045, 0.085), glaze, hide="bottom top"),
        cone((x, 0, z + 0.1), 0.12, (0.085, 0.03), glaze, hide="bottom"),
    ]
    return [*vase, *_book_row(x0 + 0.34, x1, z, depth, tall, rng)]


def _frame_cell(x0, x1, z, depth, tall, rng) -> list[Solid]:
    photo = drawn(
        drawings.framed(drawings.landscape(sunset=True), (0.15, 0.13, 0.12), frame_m=0.015, mat_m=0.015), 0.0015
    )
    frame = box(
        (x1 - 0.2, -0.02, z + 0.12), (0.3, 0.02, 0.23), plain(0.15, 0.13, 0.12), turn=(0, 0, -10), special={"y-": photo}
    )
    return [*_book_row(x0 + 0.004, x0 + 0.3, z, depth, tall, rng), frame]


def _crate_cell(x0, x1, z, depth, tall, rng) -> list[Solid]:
    weave = drawn(textures.stripes([(0.74, 0.6, 0.4), (0.6, 0.46, 0.28)], 0.015, "v"), 0.003)
    label = drawn(
        drawings.text_poster(
            "TOOLS", ["tape", "string", "bulbs"], (0.93, 0.9, 0.82), (0.2, 0.2, 0.2), (0.6, 0.2, 0.15)
        ),
        0.0015,
    )
    crate = box((x0 + 0.2, 0.01, z + 0.1), (0.34, 0.22, 0.2), weave, hide="z-")
    tag = box((x0 + 0.2, -0.102, z + 0.11), (0.12, 0.004, 0.1), plain(0.9, 0.9, 0.85), hide="y+", special={"y-": label})
    return [crate, tag, *_book_row(x0 + 0.4, x1 - 0.05, z, depth, tall, rng)]


def floor_lamp() -> list[Solid]:
    """A shade on a thin pole, 1.6 m high."""
    metal = plain(0.16, 0.15, 0.15, gloss=0.4)
    shade = glowing((1.0, 0.88, 0.68), 0.97)
    return [
        cone((0, 0, 0), 0.025, (0.14, 0.13), metal, hide="bottom"),
        cone((0, 0, 0.025), 1.32, (0.011, 0.011), metal, hide="bottom top"),
        _unshadowed(cone((0, 0, 1.34), 0.26, (0.19, 0.13), shade)),
    ]


def pendant(length: float = 0.62) -> list[Solid]:
    """A lamp that hangs from its origin on the ceiling."""
    metal, inside = plain(0.82, 0.45, 0.25, gloss=0.5), glowing((1.0, 0.95, 0.85), 1.0)
    z = -length
    return [
        cone((0, 0, -0.025), 0.025, (0.05, 0.05), plain(*_WHITE), hide="top"),
        cone((0, 0, z + 0.16), length - 0.18, (0.004, 0.004), plain(0.1, 0.1, 0.1), hide="bottom top"),
        _unshadowed(cone((0, 0, z), 0.16, (0.17, 0.035), metal, special={"bottom": inside})),
        _unshadowed(ball((0, 0, z), 0.05, inside)),
    ]


def _unshadowed(solid: Solid) -> Solid:
    import dataclasses

    return dataclasses.replace(solid, occludes=False)


def plant(rng: np.random.Generator, leaves: int = 26) -> list[Solid]:
    """A potted plant: leaves on stems that lean outwards."""
    clay, soil = (
        drawn(textures.speckled((0.72, 0.42, 0.29), (0.62, 0.34, 0.23), 0.02, 0.3), 0.005),
        plain(0.2, 0.14, 0.1),
    )
    solids: list[Solid] = [
        cone((0, 0, 0), 0.28, (0.12, 0.17), clay, hide="bottom", special={"top": soil}),
        cone((0, 0, 0.25), 0.04, (0.18, 0.185), clay, special={"top": soil}),
    ]
    stem = plain(0.33, 0.45, 0.2)
    for k in range(leaves):
        turn, z = 137.5 * k + rng.uniform(-15, 15), 0.36 + 0.82 * k / leaves + rng.uniform(-0.04, 0.04)
        reach, drop = 0.2 - 0.12 * k / leaves + rng.uniform(0, 0.05), rng.uniform(-25, 35)
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        foot, tip = (0.02 * c, 0.02 * s, 0.28), (reach * c, reach * s, z)
        half = rng.uniform(0.085, 0.13)
        p = np.radians(drop)
        centre = (tip[0] + half * c * np.cos(p), tip[1] + half * s * np.cos(p), tip[2] - half * np.sin(p))
        tone = rng.uniform(0.8, 1.15)
        green = drawn(textures.leaf((0.22 * tone, 0.46 * tone, 0.18 * tone)), 0.004)
        solids.append(rod(foot, tip, 0.004, stem, hide="bottom top"))
        solids.append(ball(centre, (half, 0.4 * half, 0.006), green, turn=(turn, drop, rng.uniform(-20, 20))))
    return solids


def curtain(width: float, height: float, colour: tuple[float, float, float]) -> list[Solid]:
    """Folds as a row of vertical columns; the origin is at the lower edge."""
    cloth = drawn(textures.fabric(colour, contrast=0.12), 0.005)
    n = round(width / 0.062)
    radii = [0.036 if k % 2 == 0 else 0.028 for k in range(n)]
    return [
        cone(((k + 0.5) * width / n - width / 2, 0.012 * (-1) ** k, 0), height, (r, 0.9 * r), cloth)
        for k, r in enumerate(radii)
    ]


def coffee_table() -> list[Solid]:
    """A low round table on three splayed legs."""
    top = drawn(textures.wood(_WALNUT, "u"), 0.0025, gloss=0.3)
    solids: list[Solid] = [
        cone((0, 0, 0.38), 0.035, (0.36, 0.37), drawn(textures.wood(_WALNUT, "u"), 0.006), special={"top": top})
    ]
    for a in (90, 210, 330):
        c, s = np.cos(np.radians(a)), np.sin(np.radians(a))
        solids.append(
            rod(
                (0.3 * c, 0.3 * s, 0),
                (0.22 * c, 0.22 * s, 0.38),
                0.018,
                drawn(textures.wood(_WALNUT, "v"), 0.006),
                hide="bottom top",
            )
        )
    return solids


def radiator(width: float = 1.2) -> list[Solid]:
    """A ribbed radiator."""
    white = plain(*_WHITE)
    n = round(width / 0.06)
    ribs = [cone(((k + 0.5) * width / n - width / 2, 0, 0.14), 0.56, (0.025, 0.025), white) for k in range(n)]
    rails = [box((0, 0.01, z), (width, 0.04, 0.05), white, hide="x- x+") for z in (0.2, 0.64)]
    return [*ribs, *rails]


def picture(width: float, height: float, paint, depth: float = 0.025, edge=(0.2, 0.17, 0.15)) -> list[Solid]:
    """A flat picture whose back touches the wall at its origin."""
    return [box((0, -depth / 2, 0), (width, depth, height), plain(*edge), hide="y+", special={"y-": paint})]


def set_on(solids: list[Solid], x: float, y: float, z: float, yaw_deg: int | float = 0.0) -> list[Solid]:
    """Place an object on a board at height z."""
    return placed(solids, (x, y, z), yaw_deg)
