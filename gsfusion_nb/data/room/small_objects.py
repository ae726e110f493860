"""Small objects on tables and floors: each function returns solids around the point they stand on, front towards -y."""

import numpy as np

from . import drawings, textures
from .build import ball, box, cone, drawn, plain, rod
from .solids import Solid


def mug(text: str, colour: tuple[float, float, float], ink: tuple[float, float, float]) -> list[Solid]:
    """A cup of coffee with a handle."""
    print_ = drawn(drawings.mug(text, colour, ink), 0.0012, gloss=0.6)
    glaze, coffee = plain(*colour, gloss=0.6, texel_m=0.008), plain(0.16, 0.09, 0.05, texel_m=0.008)
    return [
        cone((0, 0, 0), 0.095, (0.038, 0.041), print_, hide="bottom", special={"top": coffee}),
        rod((0.035, 0, 0.075), (0.07, 0, 0.072), 0.006, glaze),
        rod((0.07, 0, 0.078), (0.068, 0, 0.024), 0.006, glaze),
        rod((0.035, 0, 0.02), (0.07, 0, 0.028), 0.006, glaze),
    ]


def fruit_bowl(rng: np.random.Generator) -> list[Solid]:
    """A wide bowl filled with oranges and apples."""
    glaze = drawn(textures.speckled((0.90, 0.88, 0.82), (0.45, 0.4, 0.38), 0.005, 0.08), 0.003, gloss=0.5)
    solids: list[Solid] = [
        cone((0, 0, 0), 0.015, (0.06, 0.06), glaze, hide="bottom top"),
        cone((0, 0, 0.012), 0.075, (0.065, 0.15), glaze, hide="bottom"),
    ]
    skins = [
        drawn(textures.speckled((0.95, 0.55, 0.12), (0.85, 0.43, 0.08), 0.003, 0.2), 0.002, gloss=0.3),
        drawn(textures.speckled((0.72, 0.13, 0.12), (0.86, 0.55, 0.25), 0.012, 0.15), 0.002, gloss=0.5),
        drawn(textures.speckled((0.62, 0.72, 0.22), (0.72, 0.78, 0.4), 0.006, 0.15), 0.002, gloss=0.5),
    ]
    for k in range(6):
        a = 2 * np.pi * k / 5
        at = (0.082 * np.cos(a), 0.082 * np.sin(a), 0.105) if k < 5 else (0.0, 0.0, 0.15)
        size = rng.uniform(0.036, 0.042)
        solids.append(ball(at, (size, size, 0.93 * size), skins[k % 3], turn=(0, rng.uniform(-20, 20), 0)))
    return solids


def globe() -> list[Solid]:
    """A globe on a stand."""
    metal = plain(0.55, 0.42, 0.2, gloss=0.5, texel_m=0.01)
    tilt = np.radians(23)
    axis = np.array([np.sin(tilt), 0, np.cos(tilt)]) * 0.155
    centre = np.array([0, 0, 0.235])
    solids: list[Solid] = [
        cone((0, 0, 0), 0.02, (0.085, 0.07), metal, hide="bottom"),
        cone((0, 0, 0.02), 0.08, (0.012, 0.012), metal, hide="bottom top"),
        ball(centre, 0.14, drawn(drawings.globe(), 0.002, gloss=0.5), turn=(0, 23, 0)),
        rod(centre - axis, centre + axis, 0.006, metal),
    ]
    return solids


def book_stack(rng: np.random.Generator) -> list[Solid]:
    """A stack of four books, each rotated a little; the cover of the top one is visible."""
    titles = ["ATLAS", "OPTICS", "VOXELS", "GAUSS"]
    colours = [(0.14, 0.27, 0.44), (0.56, 0.16, 0.14), (0.85, 0.7, 0.3), (0.18, 0.4, 0.34)]
    solids: list[Solid] = []
    z = 0.0
    for k, (title, colour) in enumerate(zip(titles, colours, strict=True)):
        thick, ink = rng.uniform(0.022, 0.04), (0.95, 0.92, 0.82) if k != 2 else (0.2, 0.15, 0.1)
        front = drawn(drawings.cover(title, colour, ink), 0.0015)
        back = drawn(_lying_title(title, colour, ink), 0.0015)
        pages = drawn(textures.stripes([(0.93, 0.91, 0.84), (0.82, 0.8, 0.73)], 0.003, "v"), 0.002)
        faces = {"z+": front, "y-": back, "x+": pages, "x-": pages, "y+": pages}
        size = (0.24 - 0.015 * k, 0.17 - 0.01 * k, thick)
        solids.append(
            box((0, 0, z + thick / 2), size, front, turn=(rng.uniform(-14, 14), 0, 0), hide="z-", special=faces)
        )
        z += thick
    return solids


def _lying_title(title, colour, ink):
    upright = drawings.spine(title, colour, ink)

    def draw(w, h, texel_m, rng):
        return np.ascontiguousarray(np.rot90(upright(h, w, texel_m, rng)))

    return draw


def open_book() -> list[Solid]:
    """Two facing pages."""
    solids: list[Solid] = []
    for side, heading in ((-1, "CHAPTER 3"), (1, "EQUATION 9")):
        page = drawn(drawings.print_page(heading), 0.0012)
        solids.append(
            box(
                (side * 0.082, 0, 0.012),
                (0.166, 0.23, 0.016),
                plain(0.9, 0.88, 0.8),
                turn=(0, side * 2.5, 0),
                special={"z+": page},
            )
        )
    return solids


def laptop() -> list[Solid]:
    """An open laptop."""
    shell = plain(0.62, 0.63, 0.66, gloss=0.3)
    keys, display = drawn(drawings.keyboard(), 0.0015), drawn(drawings.screen(), 0.0012)
    return [
        box((0, 0, 0.009), (0.34, 0.24, 0.018), shell, hide="z-", special={"z+": keys}),
        box((0, 0.155, 0.125), (0.34, 0.01, 0.23), shell, turn=(0, 0, -15), special={"y-": display}),
    ]


def carton(size: tuple[float, float, float], text: str) -> list[Solid]:
    """A cardboard box."""
    side, lid = drawn(drawings.cardboard(text), 0.002), drawn(drawings.cardboard(""), 0.003)
    return [box((0, 0, size[2] / 2), size, side, hide="z-", special={"z+": lid})]


def toy_blocks() -> list[Solid]:
    """Three wooden cubes with letters, one on top of two."""
    solids: list[Solid] = []
    for letter, x, y, z, turn, colour in (
        ("A", -0.04, 0.0, 0.0, 12, (0.8, 0.25, 0.2)),
        ("B", 0.045, 0.015, 0.0, -18, (0.2, 0.45, 0.7)),
        ("C", 0.0, 0.005, 0.07, 5, (0.85, 0.65, 0.15)),
    ):
        face = drawn(_letter(letter, colour), 0.0015)
        solids.append(
            box(
                (x, y, z + 0.035),
                (0.07, 0.07, 0.07),
                face,
                turn=(turn, 0, 0),
                hide="z-" if z == 0 else "",
            )
        )
    return solids


def _letter(letter, colour):
    from .canvas import blank, outline, write

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.88, 0.78, 0.6))
        outline(image, 0.06, 0.06, 0.88, 0.88, colour, max(1, w // 14))
        write(image, letter, (0.2, 0.2, 0.6, 0.6), colour)
        return image

    return draw


def beach_ball(radius: float = 0.15) -> list[Solid]:
    """A ball with coloured gores."""
    gores = [
        (0.85, 0.2, 0.18),
        (0.95, 0.95, 0.92),
        (0.15, 0.45, 0.75),
        (0.95, 0.95, 0.92),
        (0.95, 0.75, 0.15),
        (0.95, 0.95, 0.92),
    ]
    return [ball((0, 0, radius), radius, drawn(drawings.ball(gores), 0.003, gloss=0.6), turn=(30, 35, 20))]
