"""Edges of depth, and the contrast of colour on them."""

from collections import abc

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from .sample import FrameFacts

JUMP = 0.08
"""A pixel is on an edge if it is nearer than its neighbour by this share of its depth."""


def depth_edges(depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """1 on pixels that are nearer than a neighbour by a depth jump, else 0.

    First, narrow holes are filled with the farther of their two sides: beside an object a
    structured-light camera does
        not measure the background, and the edge belongs to the object.
    """
    is_edge = np.zeros(depth_m.shape, bool)
    for depth, edge in ((depth_m, is_edge), (depth_m.T, is_edge.T)):
        closed_depth = _closed(depth)
        a = closed_depth[:, :-1]
        b = closed_depth[:, 1:]
        has_both = (a > 0) & (b > 0)
        edge[:, :-1] |= has_both & (b > a * (1 + JUMP))
        edge[:, 1:] |= has_both & (a > b * (1 + JUMP))
    return is_edge.astype(np.float32)


def colour_contrast(
    grey: UInt8[np.ndarray, "H W"], shape: tuple[int, ...]
) -> Float[np.ndarray, "h w"]:
    """Gradient of the grey image divided by its mean in the neighbourhood (so that texture has
    little weight), at most 4."""
    image = grey.astype(np.float32)
    if image.shape != tuple(shape):
        image = cv2.resize(
            image,
            (shape[1], shape[0]),
            interpolation=cv2.INTER_AREA,
        )
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    size = np.hypot(
        cv2.Sobel(image, cv2.CV_32F, 1, 0),
        cv2.Sobel(image, cv2.CV_32F, 0, 1),
    )
    return np.asarray(
        np.minimum(size / (cv2.blur(size, (31, 31)) + 4), 4),
        dtype=np.float32,
    )


def on_edges(
    edges: abc.Sequence[np.ndarray],
    frames: abc.Sequence[FrameFacts],
) -> float:
    """Mean colour contrast of frames on depth edges, above that of all their pixels."""
    contrasts = [(E, colour_contrast(f.grey, E.shape)) for E, f in zip(edges, frames, strict=True)]
    return sum(float((E * (G - G.mean())).sum() / max(E.sum(), 1)) for E, G in contrasts) / len(
        contrasts
    )


def _closed(depth_m: np.ndarray, reach: int = 5) -> np.ndarray:
    """Depth in which holes of at most ``2 * reach`` pixels in a row are filled with the farther
    side."""
    closing = cv2.morphologyEx(
        depth_m,
        cv2.MORPH_CLOSE,
        np.ones((1, 2 * reach + 1)),
    )
    narrow = (depth_m <= 0) & (closing > 0)
    return np.where(
        narrow,
        cv2.dilate(depth_m, np.ones((1, 4 * reach + 1))),
        depth_m,
    )
