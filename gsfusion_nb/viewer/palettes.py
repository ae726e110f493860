"""Colours of numbers and states, as the splat viewer and the pictures of a map show them."""

import functools

import numpy as np

from ..drawing import pictures as draw
from ..drawing.curves import rgb_of

STATE_COLOURS = {
    "stable_opaque": (66, 133, 198),
    "unstable_opaque": (240, 150, 50),
    "stable_transparent": (40, 200, 190),
    "unstable_transparent": (230, 60, 160),
}
"""Names as in ``state_counts``. Opaque: blue and orange; transparent, as dots: turquoise and
pink."""
PALETTES = ("turbo", "viridis", "state")
"""Depth, numbers, and the two states in the colours of ``state_picture``."""


@functools.cache
def palette(name: str) -> np.ndarray:
    """The 256 colours of a palette, bytes. [256, 3]"""
    if name != "state":
        return np.array([rgb_of(stop) for stop in draw.colour_stops(name, 256)], np.uint8)
    return np.repeat(
        [STATE_COLOURS["unstable_opaque"], STATE_COLOURS["stable_opaque"]], 128, axis=0
    ).astype(np.uint8)
