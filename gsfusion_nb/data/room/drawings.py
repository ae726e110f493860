"""What the room's surfaces look like: materials, and drawn ones such as posters, book spines, the
view from the window.

Each is a function (width_px, height_px, texel_m, rng, ...) -> uint8 [height_px, width_px, 3].
Colours are sRGB, 0..1. Lengths of materials are metres, so that a pattern has the same size with
any texel size; places in drawn pictures are fractions of the picture's size.
"""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
from numpy import ndarray

Number = int | float
Colour = tuple[Number, Number, Number]
Draw = Callable[[int, int, float, np.random.Generator], ndarray]


def noise(
    w: int,
    h: int,
    cell_w_px: float,
    cell_h_px: float,
    rng: np.random.Generator,
) -> ndarray:
    """Smooth random field in about -1..1 whose features are ``cell`` pixels large. [h, w]
    float32"""
    shape = (
        max(2, int(np.ceil(h / max(cell_h_px, 1))) + 1),
        max(2, int(np.ceil(w / max(cell_w_px, 1))) + 1),
    )
    coarse = rng.uniform(-1, 1, shape).astype(np.float32)
    return cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)


def tint(colour: Colour, shade: ndarray) -> ndarray:
    """``colour`` times ``shade`` [h, w] (or [h, w, 3]) as uint8."""
    shade = shade[..., None] if shade.ndim == 2 else shade
    return np.clip(
        shade * (255 * np.array(colour, np.float32)),
        0,
        255,
    ).astype(np.uint8)


def paint(
    w, h, texel_m, rng, colour: Colour, gradient: float = 0.06, mottle: float = 0.008
) -> ndarray:
    """Smooth wall paint, a little darker towards the bottom."""
    ramp = np.linspace(1.0, 1.0 - gradient, h, dtype=np.float32)[:, None]
    return tint(
        colour,
        ramp + mottle * noise(w, h, 0.4 / texel_m, 0.4 / texel_m, rng),
    )


def wood(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    along: str = "u",
    strength: float = 0.2,
) -> ndarray:
    """Grain along ``u`` or ``v``: bent bands plus fine fibres."""
    if along == "v":
        return np.ascontiguousarray(
            wood(h, w, texel_m, rng, colour, "u", strength).transpose(1, 0, 2)
        )
    y = np.arange(h, dtype=np.float32)[:, None] * np.float32(texel_m / 0.018)
    bend = 1.6 * noise(w, h, 0.5 / texel_m, 0.05 / texel_m, rng) + rng.uniform(0, 6)
    bands = np.sin(2 * np.pi * (0.55 * y + bend))
    fibres = noise(w, h, 0.12 / texel_m, 0.0025 / texel_m, rng)
    shade = 1.0 + strength * (
        0.35 * bands + 0.45 * fibres + 0.3 * noise(w, h, 0.3 / texel_m, 0.08 / texel_m, rng)
    )
    return tint(colour, np.stack([shade, shade**1.15, shade**1.3], -1))


def planks(
    w, h, texel_m, rng, colour: Colour, plank_m: float = 0.14, length_m: float = 1.3
) -> ndarray:
    """Floor boards along u, each with its own tone, length and grain, and dark joints."""
    image = wood(w, h, texel_m, rng, colour, "u", 0.25).astype(np.float32)
    rows = max(1, round(h * texel_m / plank_m))
    joint = max(1, round(0.003 / texel_m))
    edges = np.linspace(0, h, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        start_px = -int(rng.uniform(0, length_m) / texel_m)
        while start_px < w:
            right = start_px + int(rng.uniform(0.7, 1.2) * length_m / texel_m)
            board = image[top:bottom, max(start_px, 0) : max(right, 0)]
            board *= rng.uniform(0.8, 1.12) * np.array(
                [1, rng.uniform(0.97, 1.02), rng.uniform(0.92, 1.04)]
            )
            image[top:bottom, max(right - joint, 0) : max(right, 0)] *= 0.45
            start_px = right
        image[top : top + joint] *= 0.45
    return np.clip(image, 0, 255).astype(np.uint8)


def brick(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    mortar: Colour = (0.78, 0.75, 0.70),
    size_m: tuple[float, float] = (0.24, 0.08),
) -> ndarray:
    """Running bond; bricks vary in tone and are shaded at the lower edge."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(texel_m)
    wobble = 0.003 * noise(w, h, 0.03 / texel_m, 0.03 / texel_m, rng)
    row = np.floor(v / size_m[1]).astype(int)
    u = u + 0.5 * size_m[0] * (row % 2)
    col = np.floor(u / size_m[0]).astype(int)
    fu = u - col * size_m[0] + wobble
    fv = v - row * size_m[1] + wobble
    edge = np.minimum(
        np.minimum(fu, size_m[0] - fu),
        np.minimum(fv, size_m[1] - fv),
    )
    body = np.clip((edge - 0.005) / 0.004, 0, 1)[..., None]
    tone = rng.uniform(
        0.72,
        1.15,
        (row.max() + 1, col.max() + 1, 1),
    ) * rng.uniform(
        0.94,
        1.06,
        (row.max() + 1, col.max() + 1, 3),
    )
    rough = 1 + 0.10 * noise(w, h, 0.012 / texel_m, 0.012 / texel_m, rng) - 0.10 * (fv / size_m[1])
    bricks = tone.astype(np.float32)[row, col] * np.array(colour, np.float32) * rough[..., None]
    joints = (
        np.array(mortar, np.float32)
        * (1 + 0.05 * noise(w, h, 0.02 / texel_m, 0.02 / texel_m, rng))[..., None]
    )
    return tint((1, 1, 1), body * bricks + (1 - body) * joints)


def fabric(
    w, h, texel_m, rng, colour: Colour, thread_m: float = 0.006, contrast: float = 0.10
) -> ndarray:
    """Plain weave with uneven threads and large worn areas."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(2 * np.pi * texel_m / thread_m)
    weave = np.sin(u) * np.sin(v) if texel_m < 0.4 * thread_m else np.zeros_like(u)
    uneven = noise(w, h, 0.08 / texel_m, 0.004 / texel_m, rng) + noise(
        w, h, 0.004 / texel_m, 0.08 / texel_m, rng
    )
    wear = noise(w, h, 0.2 / texel_m, 0.2 / texel_m, rng)
    return tint(colour, 1 + contrast * (0.6 * weave + 0.45 * uneven) + 0.05 * wear)


def stripes(
    w,
    h,
    texel_m,
    rng,
    colours: list[Colour],
    width_m: float,
    along: str = "u",
) -> ndarray:
    """Woven bands of the given colours, stacked along u or v."""
    n = w if along == "u" else h
    band = (np.arange(n) * texel_m / width_m).astype(int) % len(colours)
    rows = np.array(colours, np.float32)[band]
    rows = rows[None, :] if along == "u" else rows[:, None]
    return (fabric(w, h, texel_m, rng, (1, 1, 1), contrast=0.08) * rows).astype(np.uint8)


def rug(
    w,
    h,
    texel_m,
    rng,
    colours: tuple[Colour, Colour, Colour],
    cell_m: float = 0.2,
    border_m: float = 0.12,
) -> ndarray:
    """Checker with a diamond in every cell, inside two border bands."""
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) * np.float32(texel_m)
    edge = np.minimum(
        np.minimum(u, w * texel_m - u),
        np.minimum(v, h * texel_m - v),
    )
    fu = np.abs(u / cell_m % 1 - 0.5)
    fv = np.abs(v / cell_m % 1 - 0.5)
    checker = (np.floor(u / cell_m) + np.floor(v / cell_m)).astype(int) % 2
    index = np.where(fu + fv < 0.25, 2, checker)
    index = np.where(edge < border_m, 0, index)
    index = np.where(edge < 0.75 * border_m, 2, index)
    index = np.where(edge < 0.45 * border_m, 1, index)
    index = np.where(edge < 0.2 * border_m, 0, index)
    pile = fabric(
        w,
        h,
        texel_m,
        rng,
        (1, 1, 1),
        thread_m=0.012,
        contrast=0.16,
    )
    return (pile * np.array(colours, np.float32)[index]).astype(np.uint8)


def wallpaper(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    ink: Colour,
    cell_m: float = 0.22,
) -> ndarray:
    """Rows of leaf sprigs, every second row shifted by half."""
    image = paint(w, h, texel_m, rng, colour, 0.04)
    rgb = tuple(int(255 * c) for c in ink)
    cell = cell_m / texel_m
    for row in range(int(h / cell) + 2):
        for col in range(-1, int(w / cell) + 2):
            x = (col + 0.5 * (row % 2)) * cell
            y = row * cell
            cv2.line(
                image,
                (round(x), round(y - 0.3 * cell)),
                (round(x), round(y + 0.3 * cell)),
                rgb,
                1,
                cv2.LINE_AA,
            )
            for k in range(-2, 3):
                for side in (-1, 1):
                    at = (round(x + side * 0.11 * cell), round(y + 0.12 * k * cell))
                    axes = (max(1, round(0.11 * cell)), max(1, round(0.035 * cell)))
                    cv2.ellipse(
                        image,
                        at,
                        axes,
                        -35 * side,
                        0,
                        360,
                        rgb,
                        -1,
                        cv2.LINE_AA,
                    )
    return image


def speckled(
    w,
    h,
    texel_m,
    rng,
    colour: Colour,
    dots: Colour,
    size_m: float = 0.004,
    share: float = 0.12,
) -> ndarray:
    """Fine dots on a plain ground: ceramic, fruit skin, soil."""
    field = noise(w, h, size_m / texel_m, size_m / texel_m, rng)
    mix = np.clip((field - 1 + 2 * share) * 6, 0, 1)[..., None]
    base = (
        np.array(colour, np.float32)
        * (1 + 0.08 * noise(w, h, 0.05 / texel_m, 0.05 / texel_m, rng))[..., None]
    )
    return tint(
        (1, 1, 1),
        base * (1 - mix) + np.array(dots, np.float32) * mix,
    )


def leaf(w, h, texel_m, rng, colour: Colour) -> ndarray:
    """Texture of a flat ellipsoid as a leaf: light midrib along x, side veins."""
    colat = np.linspace(0, np.pi, h, dtype=np.float32)[:, None]
    lon = np.linspace(
        0,
        2 * np.pi,
        w,
        dtype=np.float32,
    )[None]
    x = np.sin(colat) * np.cos(lon)
    y = np.abs(np.sin(colat) * np.sin(lon))
    veins = 0.16 * np.clip(
        1 - 4 * np.abs(np.sin(12 * (x - 0.6 * y))),
        0,
        1,
    )
    rib = 0.35 * np.clip(1 - 14 * y, 0, 1)
    return tint(
        colour,
        0.9 + veins + rib + 0.1 * noise(w, h, w / 6, h / 6, rng),
    )


def blank(w: int, h: int, colour: Colour) -> ndarray:
    """A picture of one colour. [h, w, 3] uint8"""
    return np.full((h, w, 3), rgb255(colour), np.uint8)


def rgb255(colour: Colour) -> tuple[int, int, int]:
    """A colour in OpenCV's form."""
    r, g, b = (int(255 * min(max(c, 0.0), 1.0)) for c in colour)
    return r, g, b


def write(
    image: ndarray,
    text: str,
    box: tuple[Number, Number, Number, Number],
    colour: Colour,
    serif: bool = False,
) -> None:
    """Draw ``text`` centred in ``box`` (x, y, width, height), as large as possible."""
    font = cv2.FONT_HERSHEY_TRIPLEX if serif else cv2.FONT_HERSHEY_DUPLEX
    h, w = image.shape[:2]
    x = box[0] * w
    y = box[1] * h
    bw = box[2] * w
    bh = box[3] * h
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = min(bw / max(tw, 1), bh / max(th, 1))
    thickness = max(1, round(1.6 * scale))
    (tw, th), _ = cv2.getTextSize(text, font, scale, thickness)
    at = (round(x + (bw - tw) / 2), round(y + (bh + th) / 2))
    cv2.putText(
        image,
        text,
        at,
        font,
        scale,
        rgb255(colour),
        thickness,
        cv2.LINE_AA,
    )


def _pixels(image: ndarray, points: list[tuple[Number, Number]]) -> ndarray:
    h, w = image.shape[:2]
    return np.array(
        [[round(x * w), round(y * h)] for x, y in points],
        np.int32,
    )


def poly(
    image: ndarray,
    points: list[tuple[Number, Number]],
    colour: Colour,
) -> None:
    """A filled polygon."""
    cv2.fillPoly(image, [_pixels(image, points)], rgb255(colour), cv2.LINE_AA)


def rect(
    image: ndarray,
    x: Number,
    y: Number,
    w: Number,
    h: Number,
    colour: Colour,
) -> None:
    """A filled upright rectangle from its top left corner."""
    poly(
        image,
        [(x, y), (x + w, y), (x + w, y + h), (x, y + h)],
        colour,
    )


def outline(
    image: ndarray,
    x: Number,
    y: Number,
    w: Number,
    h: Number,
    colour: Colour,
    width_px: int = 1,
) -> None:
    """The border of an upright rectangle."""
    line(
        image,
        [(x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)],
        colour,
        width_px,
    )


def dot(
    image: ndarray,
    x: Number,
    y: Number,
    r: Number,
    colour: Colour,
) -> None:
    """A filled circle; ``r`` as a fraction of the width."""
    h, w = image.shape[:2]
    cv2.circle(
        image,
        (round(x * w), round(y * h)),
        max(1, round(r * w)),
        rgb255(colour),
        -1,
        cv2.LINE_AA,
    )


def line(
    image: ndarray,
    points: list[tuple[Number, Number]],
    colour: Colour,
    width_px: int = 1,
) -> None:
    """An open polyline."""
    cv2.polylines(
        image,
        [_pixels(image, points)],
        False,
        rgb255(colour),
        max(1, width_px),
        cv2.LINE_AA,
    )


def shaded(colour: Colour, share: float) -> Colour:
    """A darker colour."""
    r, g, b = colour
    return r * share, g * share, b * share


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
