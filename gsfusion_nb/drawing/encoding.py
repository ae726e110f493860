"""Pictures as the bytes of a JPEG or PNG file, and as text for an HTML page."""

import base64
import io
from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from ..errors import ArgumentError
from .pictures import ImageLike, Picture, to_uint8


def encode_jpeg(image: ImageLike, quality: int = 88) -> bytes:
    """JPEG bytes of an RGB picture: for photographs (640x480 in about 2 ms)."""
    return _encode(
        to_uint8(image)[..., ::-1],
        ".jpg",
        [cv2.IMWRITE_JPEG_QUALITY, quality],
    )


def encode_png(image: ImageLike, compression: int = 6) -> bytes:
    """PNG bytes of an RGB picture: for drawings, where JPEG would blur the lines."""
    return _encode(
        to_uint8(image)[..., ::-1],
        ".png",
        [cv2.IMWRITE_PNG_COMPRESSION, compression],
    )


def encode_palette(image: UInt8[np.ndarray, "H W C"]) -> bytes:
    """PNG bytes with 128 colours: a quarter of the size, for a graph that a notebook stores. C is
    3, or 4 with its opacity."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).quantize(128, method=Image.Quantize.FASTOCTREE).save(
        buffer, "PNG", optimize=True
    )
    return buffer.getvalue()


def encode_rgba(rgba: UInt8[np.ndarray, "H W 4"]) -> bytes:
    """PNG bytes of a picture with its opacity, written fast: for what is sent to a browser while it
    changes."""
    return _encode(
        cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]
    )


def data_uri(image: ImageLike, kind: Literal["jpeg", "png", "graph"] = "jpeg") -> str:
    """The picture as text for an HTML page; a graph has 128 colours (``encode_palette``)."""
    format_name, encode = _ENCODERS[kind]
    content = base64.b64encode(encode(to_uint8(image))).decode("ascii")
    return f"data:image/{format_name};base64,{content}"


_ENCODERS: dict[str, tuple[str, Callable[[Picture], bytes]]] = {
    "jpeg": ("jpeg", encode_jpeg),
    "png": ("png", encode_png),
    "graph": ("png", encode_palette),
}
"""Kind of a ``data_uri`` -> its format and what encodes it."""


def _encode(pixels: np.ndarray, suffix: str, options: list[int]) -> bytes:
    """Bytes of a file from pixels in OpenCV's order, blue first."""
    done, encoded = cv2.imencode(suffix, pixels, options)
    if not done:
        raise ArgumentError(
            f"OpenCV could not encode a picture of shape {list(pixels.shape)} as {suffix}"
        )
    return encoded.tobytes()
