"""Decoding one colour or depth image, with errors that name the file. OpenCV is imported on first use."""

from pathlib import Path

import numpy as np

from ..sequence import BadFrameError


def read_rgb(path: Path) -> np.ndarray:
    """8-bit colour image as stored (EXIF orientation is ignored, because the intrinsics refer to the stored pixels).

    Grey images become colour, an alpha channel is dropped, 16-bit images are reduced to 8 bits.

    Returns:
        RGB, uint8. [H, W, 3]

    Raises:
        BadFrameError: the file is missing, truncated or no image.
    """
    return decode_rgb(read_image_bytes(path, "colour"), path)


def decode_rgb(data: bytes, source: Path | str) -> np.ndarray:
    """``read_rgb`` of an encoded image in memory; ``source`` is its name for messages."""
    import cv2

    bgr = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, source, "colour")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_depth(path: Path, *, scale: float, invalid: tuple[int, ...] = ()) -> np.ndarray:
    """z-depth in metres from a 16-bit image.

    Args:
        path: Single-channel 16-bit image (PNG, TIFF or PGM).
        scale: Stored value of one metre.
        invalid: Stored values that mean "missing", besides 0.

    Returns:
        Depth in metres, 0 where missing, float32. [H, W]

    Raises:
        BadFrameError: the file is missing, truncated, not 16-bit single-channel, or holds no valid pixel.
    """
    import cv2

    raw = decode_image(read_image_bytes(path, "depth"), cv2.IMREAD_UNCHANGED, path, "depth")
    if raw.dtype != np.uint16 or raw.ndim != 2:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise BadFrameError(f"{path} must be a 16-bit depth image of one channel, got {raw.dtype} with {channels}")
    depth_m = raw.astype(np.float32)
    depth_m *= np.float32(1.0 / scale)
    for value in invalid:
        if value != 0:
            depth_m[raw == value] = 0.0
    if not depth_m.any():
        raise BadFrameError(
            f"{path} holds no valid depth: every pixel is {' or '.join(map(str, sorted({0, *invalid})))}"
        )
    return depth_m


def read_image_bytes(path: Path, kind: str) -> bytes:
    """Content of an image file. Raises ``BadFrameError`` when it is missing, unreadable or empty."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise BadFrameError(f"{path} does not exist; expected the {kind} image of this frame") from None
    except OSError as e:
        raise BadFrameError(f"{path} cannot be read ({e.strerror}); expected a {kind} image") from None
    if not data:
        raise BadFrameError(f"{path} is empty; expected a {kind} image")
    return data


def decode_image(data: bytes, flags: int, source: Path | str, kind: str) -> np.ndarray:
    """Pixels of an encoded image, as ``cv2.imdecode`` gives them. Raises ``BadFrameError`` naming ``source``."""
    import cv2

    if _jpeg_is_cut(data):
        raise BadFrameError(
            f"{source} is truncated; expected a whole {kind} image, but its end-of-image mark is missing"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise BadFrameError(
            f"{source} cannot be decoded: it is truncated, damaged or not an image; expected a {kind} image"
        )
    return image


def _jpeg_is_cut(data: bytes) -> bool:
    """A JPEG whose last scan has no end mark: some OpenCV versions fill the rest with grey instead of failing.

    Entropy-coded data never contain FF D9, but an embedded thumbnail does, hence the comparison of places.
    """
    return data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
