"""Confidence maps beside depth images: StrayScanner's, ARKitScenes' and Polycam's
``confidence/``."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...data.recorded.images import decode_image, read_image_bytes
from ...files import is_file

_FOLDER = "confidence"
_BYTES_OF_LEVELS = (0, 85, 170)
"""Polycam writes 0, 127 and 255 for ARKit's 0, 1 and 2."""


@dataclass(frozen=True)
class DepthConfidence:
    """Which pixels of a depth image are kept."""

    file: Path
    least: int
    """ARKit's confidence: 1 medium, 2 high."""

    def without_doubtful(self, depth_m: np.ndarray) -> np.ndarray:
        """Depth without the pixels of less confidence; unchanged where the map has another size.
        [H, W]"""
        levels = decode_image(
            read_image_bytes(self.file, "confidence"), cv2.IMREAD_UNCHANGED, self.file, "confidence"
        )
        if levels.shape != depth_m.shape:
            return depth_m
        least = self.least if levels.max() <= 2 else _BYTES_OF_LEVELS[self.least]
        return np.where(levels >= least, depth_m, np.float32(0.0))


def confidence_of(depth: Path, least: int) -> DepthConfidence | None:
    """The confidence of a depth image, from the folder beside its own; None: there is none, or all
    pixels are kept."""
    file = depth.parent.with_name(_FOLDER) / f"{depth.stem}.png"
    return DepthConfidence(file, least) if least > 0 and is_file(file) else None
