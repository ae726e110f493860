"""Drawn surfaces with text and figures: posters, book spines, the view from the window, the globe, the clock."""

import numpy as np

from .canvas import blank, dot, line, outline, poly, rect, write
from .textures import Colour, Draw, fabric, noise, paint, tint


def shaded(colour: Colour, share: float) -> Colour:
    """A darker colour."""
    r, g, b = colour
    return r * share, g * share, b * share


def text_poster(title: str, lines: list[str], ground: Colour, ink: Colour, accent: Colour) -> Draw:
    """A title, a coloured band, and lines of small print."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, ground)
        write(image, title, (0.06, 0.05, 0.88, 0.16), ink, serif=True)
        rect(image, 0.06, 0.25, 0.88, 0.03, accent)
        step = 0.66 / len(lines)
        for k, words in enumerate(lines):
            write(image, words, (0.08, 0.31 + k * step, 0.84, 0.62 * step), ink if k % 2 == 0 else accent)
        return image

    return draw


def eye_chart() -> Draw:
    """Rows of letters that shrink downwards."""
    rows = ["E", "F P", "T O Z", "L P E D", "P E C F D", "E D F C Z P", "F E L O P Z D", "D E F P O T E C"]

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.96, 0.96, 0.94))
        y, height = 0.05, 0.19
        for row in rows:
            write(image, row, (0.1, y, 0.8, height), (0.06, 0.06, 0.07))
            y, height = y + height + 0.028, height * 0.72
        return image

    return draw


def circles_poster() -> Draw:
    """A grid of coloured squares with concentric circles."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.9, 0.87, 0.8))
        nx, ny = 4, max(2, round(4 * h / w))
        for i in range(nx):
            for j in range(ny):
                x, y = (i + 0.5) / nx, (j + 0.5) / ny
                c = rng.uniform(0.1, 0.95, (5, 3))
                a, b = 0.48 / nx, 0.48 / ny
                rect(image, x - a, y - b, 2 * a, 2 * b, tuple(c[0]))
                for k in range(1, 5):
                    dot(image, x, y, (0.46 - 0.1 * k) / nx + 0.012, tuple(c[k]))
        return image

    return draw


def landscape(sunset: bool = False) -> Draw:
    """Sky, layered hills, trees and a few houses."""

    def draw(w, h, texel_m, rng):
        top, low = ((0.35, 0.25, 0.5), (0.98, 0.7, 0.4)) if sunset else ((0.42, 0.66, 0.93), (0.9, 0.95, 0.98))
        ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
        clouds = np.clip(noise(w, h, w / 5, h / 12, rng) + 0.5 * noise(w, h, w / 14, h / 30, rng) - 0.2, 0, 1)[
            ..., None
        ]
        sky = np.array(top) * (1 - ramp) + np.array(low) * ramp
        image = tint((1, 1, 1), (sky + (1 - sky) * 0.75 * clouds).astype(np.float32))
        dot(image, 0.72, 0.42 if sunset else 0.16, 0.06, (1.0, 0.95, 0.75))
        greens = [(0.55, 0.66, 0.74), (0.42, 0.6, 0.5), (0.33, 0.52, 0.28), (0.25, 0.42, 0.18)]
        for k, green in enumerate(greens):
            x = np.linspace(0, 1, 60)
            phase = rng.uniform(0, 6, 3)
            ridge = 0.52 + 0.1 * k + 0.06 * np.sin(5 * x + phase[0]) + 0.025 * np.sin(17 * x + phase[1])
            poly(image, [*zip(x, ridge, strict=True), (1, 1), (0, 1)], shaded(green, 0.7 if sunset else 1.0))
        for _ in range(26):
            x, y, s = rng.uniform(0, 1), rng.uniform(0.78, 0.97), rng.uniform(0.025, 0.06)
            poly(image, [(x - s / 2, y), (x + s / 2, y), (x, y - 2.5 * s)], (0.1, rng.uniform(0.25, 0.4), 0.14))
        for x in rng.uniform(0.05, 0.9, 4):
            y = rng.uniform(0.7, 0.85)
            rect(image, x, y - 0.08, 0.08, 0.08, (0.9, 0.85, 0.75))
            poly(image, [(x - 0.01, y - 0.08), (x + 0.09, y - 0.08), (x + 0.04, y - 0.14)], (0.65, 0.25, 0.18))
            rect(image, x + 0.03, y - 0.05, 0.02, 0.05, (0.3, 0.2, 0.15))
        return image

    return draw


def framed(
    inner: Draw, frame: Colour, mat: Colour = (0.95, 0.94, 0.9), frame_m: float = 0.03, mat_m: float = 0.05
) -> Draw:
    """``inner`` with a mat and a frame around it."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, frame)
        f, m = round(frame_m / texel_m), round((frame_m + mat_m) / texel_m)
        image[f : h - f, f : w - f] = blank(1, 1, mat)
        outline(image, f / w, f / h, 1 - 2 * f / w, 1 - 2 * f / h, shaded(frame, 0.6))
        if w > 2 * m + 4 and h > 2 * m + 4:
            image[m : h - m, m : w - m] = inner(w - 2 * m, h - 2 * m, texel_m, rng)
        return image

    return draw


def spine(title: str, colour: Colour, ink: Colour) -> Draw:
    """A book's back: title along its length, bands at both ends."""

    def draw(w, h, texel_m, rng):
        lying = np.ascontiguousarray(paint(colour, 0.0, 0.03)(h, w, texel_m, rng))
        for x in (0.06, 0.1, 0.9, 0.94):
            line(lying, [(x, 0), (x, 1)], ink, round(0.002 / texel_m))
        write(lying, title, (0.14, 0.18, 0.72, 0.64), ink)
        return np.ascontiguousarray(np.rot90(lying, -1))  # reads from top to bottom

    return draw


def cover(title: str, colour: Colour, ink: Colour) -> Draw:
    """The front of a book: title, a figure, an author line."""

    def draw(w, h, texel_m, rng):
        image = np.ascontiguousarray(paint(colour, 0.0, 0.03)(w, h, texel_m, rng))
        write(image, title, (0.1, 0.08, 0.8, 0.18), ink, serif=True)
        for k in range(4):
            dot(image, 0.5, 0.55, 0.26 - 0.06 * k, ink if k % 2 == 0 else colour)
        write(image, "A. N. AUTHOR", (0.25, 0.86, 0.5, 0.07), ink)
        return image

    return draw


def print_page(heading: str) -> Draw:
    """An open page: heading and lines of words."""
    words = ["the map", "grows", "with every", "frame", "and each", "voxel", "keeps", "the mean", "of what", "it saw"]

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.95, 0.93, 0.87))
        write(image, heading, (0.2, 0.05, 0.6, 0.06), (0.1, 0.1, 0.12), serif=True)
        for k in range(16):
            line = " ".join(rng.choice(words, 5))
            write(image, line, (0.1, 0.15 + 0.05 * k, 0.8, 0.03), (0.15, 0.15, 0.17))
        return image

    return draw


def screen() -> Draw:
    """A laptop's screen: an editor with coloured lines beside a little plot."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.1, 0.11, 0.15))
        for k in range(14):
            x = 0.05 + 0.03 * rng.integers(0, 4)
            for _ in range(rng.integers(2, 5)):
                length = rng.uniform(0.03, 0.12)
                y = 0.08 + 0.06 * k
                poly(
                    image,
                    [(x, y), (x + length, y), (x + length, y + 0.03), (x, y + 0.03)],
                    tuple(rng.uniform(0.4, 0.95, 3)),
                )
                x += length + 0.02
        rect(image, 0.6, 0.1, 0.35, 0.45, (0.93, 0.93, 0.95))
        x = np.linspace(0.62, 0.93, 30)
        y = 0.48 - 0.3 * (1 - np.exp(-(x - 0.62) * 9))
        line(image, list(zip(x, y, strict=True)), (0.86, 0.24, 0.2), w // 120)
        write(image, "gsfusion", (0.62, 0.65, 0.3, 0.1), (0.9, 0.8, 0.4))
        return image

    return draw


def keyboard() -> Draw:
    """Rows of keys and a touch pad."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.62, 0.63, 0.66))
        for r in range(5):
            for c in range(13):
                x, y = 0.05 + c * 0.07, 0.08 + r * 0.1
                rect(image, x, y, 0.055, 0.08, (0.13, 0.13, 0.14))
        rect(image, 0.35, 0.65, 0.3, 0.29, (0.52, 0.53, 0.56))
        return image

    return draw


def cardboard(text: str) -> Draw:
    """The side of a cardboard box: tape, text, an arrow."""

    def draw(w, h, texel_m, rng):
        image = tint((0.72, 0.56, 0.38), 1 + 0.05 * noise(w, h, 0.006 / texel_m, 0.2 / texel_m, rng))
        rect(image, 0.44, 0, 0.12, 0.32, (0.82, 0.72, 0.5))
        write(image, text, (0.1, 0.42, 0.8, 0.22), (0.25, 0.1, 0.08))
        write(image, "THIS SIDE UP", (0.1, 0.72, 0.45, 0.1), (0.2, 0.15, 0.12))
        poly(
            image,
            [(0.75, 0.95), (0.85, 0.95), (0.85, 0.82), (0.9, 0.82), (0.8, 0.7), (0.7, 0.82), (0.75, 0.82)],
            (0.25, 0.1, 0.08),
        )
        return image

    return draw


def globe() -> Draw:
    """Seas, invented continents, and a graticule on longitude and colatitude."""

    def draw(w, h, texel_m, rng):
        colat = np.linspace(0, np.pi, h, dtype=np.float32)[:, None]
        lon = np.linspace(0, 2 * np.pi, w, dtype=np.float32)[None]
        land = np.zeros((h, w), np.float32)
        for _ in range(7):
            a, b, k, m = rng.uniform(0, 6.3), rng.uniform(0.5, 2.6), rng.integers(1, 4), rng.uniform(1.5, 4)
            land += np.cos(k * lon + a) * np.sin(colat) * np.cos(m * colat + b)
        land += 0.25 * noise(w, h, w / 24, h / 12, rng)
        height = np.clip((land - 0.2) / 1.5, 0, 1)[..., None]
        ground = np.array([0.45, 0.62, 0.3]) * (1 - height) + np.array([0.75, 0.58, 0.35]) * height
        sea = np.array([0.18, 0.42, 0.68])
        image = tint((1, 1, 1), np.where(land[..., None] > 0.2, ground, sea).astype(np.float32))
        image[np.sin(colat)[:, 0] < 0.3] = (235, 240, 245)
        for k in range(12):
            line(image, [(k / 12, 0), (k / 12, 1)], (0.88, 0.86, 0.78))
            line(image, [(0, k / 12), (1, k / 12)], (0.88, 0.86, 0.78))
        return image

    return draw


def ball(colours: list[Colour]) -> Draw:
    """Coloured gores with white caps."""

    def draw(w, h, texel_m, rng):
        gore = (np.arange(w) * len(colours) // w)[None].repeat(h, 0)
        image = tint((1, 1, 1), np.array(colours, np.float32)[gore])
        image[: h // 10] = image[-(h // 10) :] = 245
        return image

    return draw


def clock() -> Draw:
    """A dial with twelve numerals and hands at ten past ten."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, (0.12, 0.12, 0.13))
        dot(image, 0.5, 0.5, 0.45, (0.97, 0.96, 0.92))
        for k in range(1, 13):
            a = np.pi / 6 * k
            x, y = 0.5 + 0.36 * np.sin(a), 0.5 - 0.36 * np.cos(a)
            write(image, str(k), (x - 0.05, y - 0.045, 0.1, 0.09), (0.1, 0.1, 0.1))
        for a, r, width in ((-0.29 * np.pi, 0.22, 0.03), (np.pi / 3, 0.32, 0.02)):
            tip = (0.5 + r * np.sin(a), 0.5 - r * np.cos(a))
            line(image, [(0.5, 0.5), tip], (0.08, 0.08, 0.09), round(width * w))
        return image

    return draw


def door() -> Draw:
    """Painted wood with four sunk panels."""

    def draw(w, h, texel_m, rng):
        image = tint((0.86, 0.84, 0.78), 1 + 0.02 * noise(w, h, 0.02 / texel_m, 0.6 / texel_m, rng))
        edge = max(1, round(0.012 / texel_m))
        for x in (0.12, 0.55):
            for y, tall in ((0.07, 0.35), (0.52, 0.41)):
                outline(image, x, y, 0.33, tall, (0.62, 0.6, 0.55), edge)
                line(image, [(x, y + tall), (x + 0.33, y + tall), (x + 0.33, y)], (0.97, 0.96, 0.92), edge)
        return image

    return draw


def mug(text: str, colour: Colour, ink: Colour) -> Draw:
    """A band of text around a mug."""

    def draw(w, h, texel_m, rng):
        image = blank(w, h, colour)
        for k in range(2):
            write(image, text, (0.05 + 0.5 * k, 0.3, 0.4, 0.4), ink)
        for y in (0.1, 0.88):
            rect(image, 0, y, 1, 0.04, ink)
        return image

    return draw


def lettered_cushion(text: str, colour: Colour, ink: Colour) -> Draw:
    """Fabric with a word and a frame on it."""

    def draw(w, h, texel_m, rng):
        image = np.ascontiguousarray(fabric(colour)(w, h, texel_m, rng))
        write(image, text, (0.2, 0.35, 0.6, 0.3), ink, serif=True)
        outline(image, 0.12, 0.12, 0.76, 0.76, ink, round(0.006 / texel_m))
        return image

    return draw
