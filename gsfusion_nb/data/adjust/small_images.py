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
    has_depth = depth_m > 0
    counts = cv2.boxFilter(
        has_depth.astype(np.float32),
        -1,
        (3, 3),
        normalize=False,
        borderType=cv2.BORDER_REFLECT_101,
    )
    if not has_depth.any() or float((counts[has_depth] - 1).mean()) >= 8 * _SPECKLED:
        return depth_m.copy()
    with_border = np.pad(
        np.where(has_depth, depth_m, np.nan),
        2,
        constant_values=np.nan,
    )
    windows = np.lib.stride_tricks.sliding_window_view(with_border, (5, 5)).reshape(
        *depth_m.shape, 25
    )
    fillable = ~has_depth & (np.isfinite(windows).sum(axis=2) >= _FILLED_FROM)
    result = depth_m.copy()
    result[fillable] = np.nanmedian(windows[fillable], axis=1)
    return result
