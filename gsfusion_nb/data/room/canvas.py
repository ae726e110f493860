"""Text and shapes drawn on a picture; places are fractions of its size, colours sRGB, 0..1."""

import cv2
import numpy as np
from numpy import ndarray

from .materials import Colour, Number, rgb255


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
