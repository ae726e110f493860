"""Writing one colour or depth image of a recording."""

from pathlib import Path

import numpy as np


def write_rgb(path: Path, rgb: np.ndarray) -> None:
    """Write an RGB image, uint8 [H, W, 3], as ``.jpg`` (quality 97, colour at full resolution) or ``.png``."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    jpeg = path.suffix.lower() == ".jpg"
    whole_colour = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = [cv2.IMWRITE_JPEG_QUALITY, 97, *whole_colour] if jpeg else [cv2.IMWRITE_PNG_COMPRESSION, 3]
    path.write_bytes(cv2.imencode(".jpg" if jpeg else ".png", rgb[..., ::-1], options)[1].tobytes())


def write_depth(path: Path, depth_m: np.ndarray, scale: float) -> None:
    """Write depth in metres [H, W] as a 16-bit PNG with ``scale`` units per metre; 0 stays 0."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.rint(depth_m * scale).astype(np.uint16))[1].tobytes())
