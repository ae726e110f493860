"""Small copies of a frame's images, in which frames are compared."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...types import Frame


def small_grey(frame: Frame, most_width: int) -> UInt8[np.ndarray, "h w"]:
    """The picture in grey levels, averaged down to at most ``most_width`` pixels."""
    grey = cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    h, w = grey.shape
    if w > most_width:
        grey = cv2.resize(
            grey, (most_width, round(h * most_width / w)), interpolation=cv2.INTER_AREA
        )
    return np.asarray(grey)


_SPECKLED = 0.75
"""Where of the eight neighbours of a pixel with depth fewer have depth, on average, single pixels
are missing: of a hand-held Kinect 0.93 and more have."""
_FILLED_FROM = 3
"""Fewest pixels with depth among the 24 around one that is filled."""


def without_speckle(depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth of which single pixels are missing everywhere (a scanner, a projected LiDAR), filled
    with the median of the pixels around each; depth with holes, as other cameras have it, is
    copied.

    Frames are compared by interpolating depth between four pixels, which hardly ever all have it in
    such images.
    """
    known = depth_m > 0
    counts = cv2.boxFilter(
        known.astype(np.float32),
        -1,
        (3, 3),
        normalize=False,
        borderType=cv2.BORDER_REFLECT_101,
    )
    if not known.any() or float((counts[known] - 1).mean()) >= 8 * _SPECKLED:
        return depth_m.copy()
    padded = np.pad(
        np.where(known, depth_m, np.nan),
        2,
        constant_values=np.nan,
    )
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*depth_m.shape, 25)
    fillable = ~known & (np.isfinite(around).sum(axis=2) >= _FILLED_FROM)
    filled = depth_m.copy()
    filled[fillable] = np.nanmedian(around[fillable], axis=1)
    return filled
