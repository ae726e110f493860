"""Pictures on things in the room: a screen, a globe, toys, a cushion.

Each is a function as those of ``drawings``."""

import numpy as np
from numpy import ndarray

from .canvas import line, outline, poly, rect, write
from .materials import Colour, blank, fabric, noise, tint


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
