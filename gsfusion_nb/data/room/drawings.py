"""Pictures on the walls of the room: posters, the view from the window, the clock, the door.

Each is a function (width_px, height_px, texel_m, rng, ...) -> uint8 [height_px, width_px, 3].
Places are fractions of the picture's size.
"""

import numpy as np
from numpy import ndarray

from .canvas import dot, line, outline, poly, rect, shaded, write
from .materials import Colour, Draw, blank, noise, tint


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
