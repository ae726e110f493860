"""Small things on tables, walls and the floor: each function returns one as solids around the point
it stands on, front towards -y."""

import numpy as np

from . import materials
from . import thing_drawings as draw
from .painted import ball, box, cone, drawn, plain, rod
from .solids import Colour, Paint, Solid


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
        materials.speckled,
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
            materials.speckled,
            (0.95, 0.55, 0.12),
            (0.85, 0.43, 0.08),
            0.003,
            0.2,
        ),
        drawn(
            0.002,
            materials.speckled,
            (0.72, 0.13, 0.12),
            (0.86, 0.55, 0.25),
            0.012,
            0.15,
        ),
        drawn(
            0.002,
            materials.speckled,
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
