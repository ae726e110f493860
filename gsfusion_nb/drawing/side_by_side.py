"""Pictures in a row, each with a label above it."""

from collections.abc import Sequence

import numpy as np

from .ground import CARD, CARD_INK
from .pictures import AnyImage, Picture, to_uint8

LABEL_PX = 26
"""Height of the strip with the labels."""


def side_by_side(images: Sequence[AnyImage], labels: Sequence[str] = (), *, gap: int = 6) -> Picture:
    """Images in a row at the height of the first, with a label strip above if there are labels.

    Args:
        images: At least one image, 0..1 or bytes; others are scaled to the first one's height.
        labels: One per image, or none.
        gap: Space between images, pixels.
    """
    import cv2

    if not images:
        raise ValueError("side_by_side needs at least one image, got none")
    if labels and len(labels) != len(images):
        raise ValueError(f"side_by_side needs one label per image, got {len(labels)} labels for {len(images)} images")
    height = images[0].shape[0]
    columns = []
    for i, image in enumerate(images):
        picture = to_uint8(image)
        if picture.shape[0] != height:
            width = max(1, round(picture.shape[1] * height / picture.shape[0]))
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        if labels:
            picture = np.concatenate([_label(labels[i], picture.shape[1]), picture])
        if i:
            columns.append(np.full((picture.shape[0], gap, 3), CARD, np.uint8))
        columns.append(picture)
    return np.concatenate(columns, axis=1)


def _label(text: str, width: int) -> np.ndarray:
    """A dark strip with light text, made smaller until it fits: readable on a light and on a dark page."""
    import cv2

    strip = np.full((LABEL_PX, width, 3), CARD, np.uint8)
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (text_width, _), _ = cv2.getTextSize(text, font, size, 1)
    size *= min(1.0, (width - 8) / max(text_width, 1))
    cv2.putText(strip, text, (4, LABEL_PX - 9), font, size, CARD_INK, 1, cv2.LINE_AA)
    return strip
