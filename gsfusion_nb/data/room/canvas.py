"""Drawing on uint8 RGB pictures with coordinates as fractions of the picture's size. All functions draw in place."""

import numpy as np
from numpy import ndarray

from .textures import Colour, Number


def blank(w: int, h: int, colour: Colour) -> ndarray:
    """A picture of one colour. [h, w, 3] uint8"""
    return np.full((h, w, 3), rgb255(colour), np.uint8)


def rgb255(colour: Colour) -> tuple[int, int, int]:
    """A colour in OpenCV's form."""
    r, g, b = (int(255 * min(max(c, 0.0), 1.0)) for c in colour)
    return r, g, b


def write(
    image: ndarray, text: str, box: tuple[Number, Number, Number, Number], colour: Colour, serif: bool = False
) -> None:
    """Draw ``text`` centred in ``box`` (x, y, width, height), as large as possible."""
    import cv2

    font = cv2.FONT_HERSHEY_TRIPLEX if serif else cv2.FONT_HERSHEY_DUPLEX
    h, w = image.shape[:2]
    x, y, bw, bh = box[0] * w, box[1] * h, box[2] * w, box[3] * h
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = min(bw / max(tw, 1), bh / max(th, 1))
    thickness = max(1, round(1.6 * scale))
    (tw, th), _ = cv2.getTextSize(text, font, scale, thickness)
    at = (round(x + (bw - tw) / 2), round(y + (bh + th) / 2))
    cv2.putText(image, text, at, font, scale, rgb255(colour), thickness, cv2.LINE_AA)


def poly(image: ndarray, points: list[tuple[Number, Number]], colour: Colour) -> None:
    """A filled polygon."""
    import cv2

    h, w = image.shape[:2]
    corners = np.array([[round(x * w), round(y * h)] for x, y in points], np.int32)
    cv2.fillPoly(image, [corners], rgb255(colour), cv2.LINE_AA)


def rect(image: ndarray, x: Number, y: Number, w: Number, h: Number, colour: Colour) -> None:
    """A filled upright rectangle from its top left corner."""
    poly(image, [(x, y), (x + w, y), (x + w, y + h), (x, y + h)], colour)


def outline(image: ndarray, x: Number, y: Number, w: Number, h: Number, colour: Colour, width_px: int = 1) -> None:
    """The border of an upright rectangle."""
    line(image, [(x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)], colour, width_px)


def dot(image: ndarray, x: Number, y: Number, r: Number, colour: Colour) -> None:
    """A filled circle; ``r`` as a fraction of the width."""
    import cv2

    h, w = image.shape[:2]
    cv2.circle(image, (round(x * w), round(y * h)), max(1, round(r * w)), rgb255(colour), -1, cv2.LINE_AA)


def line(image: ndarray, points: list[tuple[Number, Number]], colour: Colour, width_px: int = 1) -> None:
    """An open polyline."""
    import cv2

    h, w = image.shape[:2]
    corners = np.array([[round(x * w), round(y * h)] for x, y in points], np.int32)
    cv2.polylines(image, [corners], False, rgb255(colour), max(1, width_px), cv2.LINE_AA)
