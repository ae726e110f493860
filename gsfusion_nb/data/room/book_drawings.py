"""Pictures on books in the room: backs, covers, pages.

Each is a function as those of ``drawings``."""

import numpy as np
from numpy import ndarray

from .canvas import dot, line, write
from .materials import Colour, blank, paint


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
