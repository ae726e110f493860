"""The ground of drawings: transparent, or a dark card; both are readable on a light and on a dark page."""

import numpy as np
from jaxtyping import Float

from .pictures import Picture, encode_rgba

CARD, CARD_INK = (43, 48, 57), (233, 237, 242)
"""Ground and text of pictures in a row; the same on every page."""
BETWEEN = (118, 128, 141)
"""Text and lines on an unknown ground; the contrast is about 4 to white and 5 to a dark page."""
_GREY = 40.0
"""Inks whose channels differ by less than this are text and lines; others are the colours of curves and bars."""


def encode_drawing(drawing: Picture) -> bytes:
    """PNG bytes of a drawing on white, where the ground becomes transparent; it looks the same on a white page.

    Ink no darker than ``BETWEEN`` stays readable on a dark page.
    """
    ink, opacity = _ink_and_opacity(drawing)
    return encode_rgba((np.concatenate([ink, 255 * opacity], axis=-1) + 0.5).astype(np.uint8))


def on_card(drawing: Picture) -> Picture:
    """A drawing on white, with the card as its ground, light text and lines, and the colours that it had."""
    ink, opacity = _ink_and_opacity(drawing)
    r, g, b = (ink[..., k, None] for k in range(3))  # much faster than reducing an axis of three
    grey = np.maximum(np.maximum(r, g), b) - np.minimum(np.minimum(r, g), b) < _GREY
    ink = np.where(grey, np.array(CARD_INK, np.float32), ink)
    return (opacity * ink + (1 - opacity) * np.array(CARD, np.float32) + 0.5).astype(np.uint8)


def _ink_and_opacity(drawing: Picture) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 1"]]:
    """For each pixel p: p = opacity ink + (1 - opacity) white; opaque from the lightness of ``BETWEEN`` on."""
    p = drawing.astype(np.float32)
    darkest = np.minimum(np.minimum(p[..., 0, None], p[..., 1, None]), p[..., 2, None])
    opacity = np.clip((255 - darkest) / (255 - BETWEEN[0]), 0, 1)
    ink = 255 - (255 - p) / np.maximum(opacity, 1e-3)
    return ink.clip(0, 255), opacity
