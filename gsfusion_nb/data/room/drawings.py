"""Pictures on things in the room: posters, the view from the window, books, pages, screens, a
globe.

Each is a function (width_px, height_px, texel_m, rng, ...) -> uint8 [height_px, width_px, 3].
Places are fractions of the picture's size.
"""

import numpy as np
from numpy import ndarray

from .canvas import dot, line, outline, poly, rect, shaded, write
from .materials import Colour, Draw, blank, fabric, noise, paint, tint


def text_poster(
    w,
    h,
    texel_m,
    rng,
    title: str,
    lines: list[str],
    ground: Colour,
    ink: Colour,
    accent: Colour,
) -> ndarray:
    """A title, a coloured band, and lines of small print."""
    image = blank(w, h, ground)
    write(image, title, (0.06, 0.05, 0.88, 0.16), ink, serif=True)
    rect(image, 0.06, 0.25, 0.88, 0.03, accent)
    step = 0.66 / len(lines)
    for k, words in enumerate(lines):
        write(
            image,
            words,
            (0.08, 0.31 + k * step, 0.84, 0.62 * step),
            ink if k % 2 == 0 else accent,
        )
    return image


def eye_chart(w, h, texel_m, rng) -> ndarray:
    """Rows of letters that shrink downwards."""
    rows = [
        "E",
        "F P",
        "T O Z",
        "L P E D",
        "P E C F D",
        "E D F C Z P",
        "F E L O P Z D",
        "D E F P O T E C",
    ]
    image = blank(w, h, (0.96, 0.96, 0.94))
    y = 0.05
    height = 0.19
    for row in rows:
        write(image, row, (0.1, y, 0.8, height), (0.06, 0.06, 0.07))
        y = y + height + 0.028
        height = height * 0.72
    return image


def circles_poster(w, h, texel_m, rng) -> ndarray:
    """A grid of coloured squares with concentric circles."""
    image = blank(w, h, (0.9, 0.87, 0.8))
    nx = 4
    ny = max(2, round(4 * h / w))
    for i in range(nx):
        for j in range(ny):
            x = (i + 0.5) / nx
            y = (j + 0.5) / ny
            c = rng.uniform(0.1, 0.95, (5, 3))
            a = 0.48 / nx
            b = 0.48 / ny
            rect(
                image,
                x - a,
                y - b,
                2 * a,
                2 * b,
                tuple(c[0]),
            )
            for k in range(1, 5):
                dot(
                    image,
                    x,
                    y,
                    (0.46 - 0.1 * k) / nx + 0.012,
                    tuple(c[k]),
                )
    return image


def landscape(w, h, texel_m, rng, sunset: bool = False) -> ndarray:
    """Sky, layered hills, trees and a few houses."""
    top, low = (
        ((0.35, 0.25, 0.5), (0.98, 0.7, 0.4)) if sunset else ((0.42, 0.66, 0.93), (0.9, 0.95, 0.98))
    )
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    clouds = np.clip(
        noise(w, h, w / 5, h / 12, rng) + 0.5 * noise(w, h, w / 14, h / 30, rng) - 0.2,
        0,
        1,
    )[..., None]
    sky = np.array(top) * (1 - ramp) + np.array(low) * ramp
    image = tint(
        (1, 1, 1),
        (sky + (1 - sky) * 0.75 * clouds).astype(np.float32),
    )
    dot(image, 0.72, 0.42 if sunset else 0.16, 0.06, (1.0, 0.95, 0.75))
    greens = [(0.55, 0.66, 0.74), (0.42, 0.6, 0.5), (0.33, 0.52, 0.28), (0.25, 0.42, 0.18)]
    for k, green in enumerate(greens):
        x = np.linspace(0, 1, 60)
        phase = rng.uniform(0, 6, 3)
        ridge = 0.52 + 0.1 * k + 0.06 * np.sin(5 * x + phase[0]) + 0.025 * np.sin(17 * x + phase[1])
        poly(
            image,
            [*zip(x, ridge, strict=True), (1, 1), (0, 1)],
            shaded(green, 0.7 if sunset else 1.0),
        )
    for _ in range(26):
        x = rng.uniform(0, 1)
        y = rng.uniform(0.78, 0.97)
        s = rng.uniform(0.025, 0.06)
        poly(
            image,
            [(x - s / 2, y), (x + s / 2, y), (x, y - 2.5 * s)],
            (0.1, rng.uniform(0.25, 0.4), 0.14),
        )
    for x in rng.uniform(0.05, 0.9, 4):
        y = rng.uniform(0.7, 0.85)
        rect(image, x, y - 0.08, 0.08, 0.08, (0.9, 0.85, 0.75))
        poly(
            image,
            [(x - 0.01, y - 0.08), (x + 0.09, y - 0.08), (x + 0.04, y - 0.14)],
            (0.65, 0.25, 0.18),
        )
        rect(image, x + 0.03, y - 0.05, 0.02, 0.05, (0.3, 0.2, 0.15))
    return image


def framed(
    w,
    h,
    texel_m,
    rng,
    inner: Draw,
    frame: Colour,
    frame_m: float,
    mat_m: float,
) -> ndarray:
    """``inner`` with a white mat and a frame around it."""
    image = blank(w, h, frame)
    f = round(frame_m / texel_m)
    m = round((frame_m + mat_m) / texel_m)
    image[f : h - f, f : w - f] = blank(1, 1, (0.95, 0.94, 0.9))
    outline(
        image,
        f / w,
        f / h,
        1 - 2 * f / w,
        1 - 2 * f / h,
        shaded(frame, 0.6),
    )
    if w > 2 * m + 4 and h > 2 * m + 4:
        image[m : h - m, m : w - m] = inner(w - 2 * m, h - 2 * m, texel_m, rng)
    return image


def spine(
    w,
    h,
    texel_m,
    rng,
    title: str,
    colour: Colour,
    ink: Colour,
) -> ndarray:
    """A book's back: title along its length, bands at both ends."""
    lying = np.ascontiguousarray(paint(h, w, texel_m, rng, colour, 0.0, 0.03))
    for x in (0.06, 0.1, 0.9, 0.94):
        line(
            lying,
            [(x, 0), (x, 1)],
            ink,
            round(0.002 / texel_m),
        )
    write(lying, title, (0.14, 0.18, 0.72, 0.64), ink)
    return np.ascontiguousarray(np.rot90(lying, -1))  # reads from top to bottom


def lying_spine(
    w,
    h,
    texel_m,
    rng,
    title: str,
    colour: Colour,
    ink: Colour,
) -> ndarray:
    """The back of a book that lies on a table."""
    return np.ascontiguousarray(np.rot90(spine(h, w, texel_m, rng, title, colour, ink)))


def cover(
    w,
    h,
    texel_m,
    rng,
    title: str,
    colour: Colour,
    ink: Colour,
) -> ndarray:
    """The front of a book: title, a figure, an author line."""
    image = np.ascontiguousarray(paint(w, h, texel_m, rng, colour, 0.0, 0.03))
    write(image, title, (0.1, 0.08, 0.8, 0.18), ink, serif=True)
    for k in range(4):
        dot(image, 0.5, 0.55, 0.26 - 0.06 * k, ink if k % 2 == 0 else colour)
    write(image, "A. N. AUTHOR", (0.25, 0.86, 0.5, 0.07), ink)
    return image


def print_page(w, h, texel_m, rng, heading: str) -> ndarray:
    """An open page: heading and lines of words."""
    words = [
        "the map",
        "grows",
        "with every",
        "frame",
        "and each",
        "voxel",
        "keeps",
        "the mean",
        "of what",
        "it saw",
    ]
    image = blank(w, h, (0.95, 0.93, 0.87))
    write(
        image,
        heading,
        (0.2, 0.05, 0.6, 0.06),
        (0.1, 0.1, 0.12),
        serif=True,
    )
    for k in range(16):
        write(
            image,
            " ".join(rng.choice(words, 5)),
            (0.1, 0.15 + 0.05 * k, 0.8, 0.03),
            (0.15, 0.15, 0.17),
        )
    return image


def screen(w, h, texel_m, rng) -> ndarray:
    """A laptop's screen: an editor with coloured lines beside a little plot."""
    image = blank(w, h, (0.1, 0.11, 0.15))
    for k in range(14):
        x = 0.05 + 0.03 * rng.integers(0, 4)
        for _ in range(rng.integers(2, 5)):
            length = rng.uniform(0.03, 0.12)
            y = 0.08 + 0.06 * k
            rect(
                image,
                x,
                y,
                length,
                0.03,
                tuple(rng.uniform(0.4, 0.95, 3)),
            )
            x += length + 0.02
    rect(image, 0.6, 0.1, 0.35, 0.45, (0.93, 0.93, 0.95))
    x = np.linspace(0.62, 0.93, 30)
    y = 0.48 - 0.3 * (1 - np.exp(-(x - 0.62) * 9))
    line(
        image,
        list(zip(x, y, strict=True)),
        (0.86, 0.24, 0.2),
        w // 120,
    )
    write(image, "gsfusion", (0.62, 0.65, 0.3, 0.1), (0.9, 0.8, 0.4))
    return image


def keyboard(w, h, texel_m, rng) -> ndarray:
    """Rows of keys and a touch pad."""
    image = blank(w, h, (0.62, 0.63, 0.66))
    for r in range(5):
        for c in range(13):
            x = 0.05 + c * 0.07
            y = 0.08 + r * 0.1
            rect(image, x, y, 0.055, 0.08, (0.13, 0.13, 0.14))
    rect(image, 0.35, 0.65, 0.3, 0.29, (0.52, 0.53, 0.56))
    return image


def cardboard(w, h, texel_m, rng, text: str) -> ndarray:
    """The side of a cardboard box: tape, text, an arrow."""
    image = tint(
        (0.72, 0.56, 0.38),
        1 + 0.05 * noise(w, h, 0.006 / texel_m, 0.2 / texel_m, rng),
    )
    rect(image, 0.44, 0, 0.12, 0.32, (0.82, 0.72, 0.5))
    write(image, text, (0.1, 0.42, 0.8, 0.22), (0.25, 0.1, 0.08))
    write(image, "THIS SIDE UP", (0.1, 0.72, 0.45, 0.1), (0.2, 0.15, 0.12))
    arrow = [
        (0.75, 0.95),
        (0.85, 0.95),
        (0.85, 0.82),
        (0.9, 0.82),
        (0.8, 0.7),
        (0.7, 0.82),
        (0.75, 0.82),
    ]
    poly(image, arrow, (0.25, 0.1, 0.08))
    return image


def globe(w, h, texel_m, rng) -> ndarray:
    """Seas, invented continents, and a graticule on longitude and colatitude."""
    colat = np.linspace(0, np.pi, h, dtype=np.float32)[:, None]
    lon = np.linspace(
        0,
        2 * np.pi,
        w,
        dtype=np.float32,
    )[None]
    land = np.zeros((h, w), np.float32)
    for _ in range(7):
        a = rng.uniform(0, 6.3)
        b = rng.uniform(0.5, 2.6)
        k = rng.integers(1, 4)
        m = rng.uniform(1.5, 4)
        land += np.cos(k * lon + a) * np.sin(colat) * np.cos(m * colat + b)
    land += 0.25 * noise(w, h, w / 24, h / 12, rng)
    height = np.clip((land - 0.2) / 1.5, 0, 1)[..., None]
    ground = np.array([0.45, 0.62, 0.3]) * (1 - height) + np.array([0.75, 0.58, 0.35]) * height
    sea = np.array([0.18, 0.42, 0.68])
    image = tint(
        (1, 1, 1),
        np.where(land[..., None] > 0.2, ground, sea).astype(np.float32),
    )
    image[np.sin(colat)[:, 0] < 0.3] = (235, 240, 245)
    for k in range(12):
        line(
            image,
            [(k / 12, 0), (k / 12, 1)],
            (0.88, 0.86, 0.78),
        )
        line(
            image,
            [(0, k / 12), (1, k / 12)],
            (0.88, 0.86, 0.78),
        )
    return image


def ball(w, h, texel_m, rng, colours: list[Colour]) -> ndarray:
    """Coloured gores with white caps."""
    gore = (np.arange(w) * len(colours) // w)[None].repeat(h, 0)
    image = tint((1, 1, 1), np.array(colours, np.float32)[gore])
    image[: h // 10] = image[-(h // 10) :] = 245
    return image


def clock(w, h, texel_m, rng) -> ndarray:
    """A dial with twelve numerals and hands at ten past ten."""
    image = blank(w, h, (0.12, 0.12, 0.13))
    dot(image, 0.5, 0.5, 0.45, (0.97, 0.96, 0.92))
    for k in range(1, 13):
        a = np.pi / 6 * k
        x = 0.5 + 0.36 * np.sin(a)
        y = 0.5 - 0.36 * np.cos(a)
        write(
            image,
            str(k),
            (x - 0.05, y - 0.045, 0.1, 0.09),
            (0.1, 0.1, 0.1),
        )
    for a, r, width in ((-0.29 * np.pi, 0.22, 0.03), (np.pi / 3, 0.32, 0.02)):
        tip = (0.5 + r * np.sin(a), 0.5 - r * np.cos(a))
        line(
            image,
            [(0.5, 0.5), tip],
            (0.08, 0.08, 0.09),
            round(width * w),
        )
    return image


def door(w, h, texel_m, rng) -> ndarray:
    """Painted wood with four sunk panels."""
    image = tint(
        (0.86, 0.84, 0.78),
        1 + 0.02 * noise(w, h, 0.02 / texel_m, 0.6 / texel_m, rng),
    )
    edge = max(1, round(0.012 / texel_m))
    for x in (0.12, 0.55):
        for y, tall in ((0.07, 0.35), (0.52, 0.41)):
            outline(image, x, y, 0.33, tall, (0.62, 0.6, 0.55), edge)
            line(
                image,
                [(x, y + tall), (x + 0.33, y + tall), (x + 0.33, y)],
                (0.97, 0.96, 0.92),
                edge,
            )
    return image


def mug(
    w,
    h,
    texel_m,
    rng,
    text: str,
    colour: Colour,
    ink: Colour,
) -> ndarray:
    """A band of text around a mug."""
    image = blank(w, h, colour)
    for k in range(2):
        write(image, text, (0.05 + 0.5 * k, 0.3, 0.4, 0.4), ink)
    for y in (0.1, 0.88):
        rect(image, 0, y, 1, 0.04, ink)
    return image


def lettered_cushion(
    w,
    h,
    texel_m,
    rng,
    text: str,
    colour: Colour,
    ink: Colour,
) -> ndarray:
    """Fabric with a word and a frame on it."""
    image = np.ascontiguousarray(fabric(w, h, texel_m, rng, colour))
    write(image, text, (0.2, 0.35, 0.6, 0.3), ink, serif=True)
    outline(image, 0.12, 0.12, 0.76, 0.76, ink, round(0.006 / texel_m))
    return image


def letter(w, h, texel_m, rng, text: str, colour: Colour) -> ndarray:
    """A face of a wooden toy block."""
    image = blank(w, h, (0.88, 0.78, 0.6))
    outline(image, 0.06, 0.06, 0.88, 0.88, colour, max(1, w // 14))
    write(image, text, (0.2, 0.2, 0.6, 0.6), colour)
    return image
