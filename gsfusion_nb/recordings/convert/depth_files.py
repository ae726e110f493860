"""Reading one image of depth, whatever program wrote it."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...data.recorded.images import (
    MAX_PIXELS,
    check_image_size,
    decode_depth,
    read_image_bytes,
)
from ...errors import BadFrameError, SequenceError
from ...files import is_file, open_regular, parsing

_LARGEST_OF_16_BITS = 65535
"""Means "missing" or "farther than can be stored" in 16 bits (7-Scenes, 2D-3D-S, Replica): no
distance."""

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".pfm", ".npy", ".exr")


def read_depth_file(path: Path, scale: float) -> np.ndarray:
    """Depth in metres of a PNG, TIFF, PGM, PFM, NumPy or OpenEXR file, 0 = missing, float32. [H, W]

    Args:
        path: One channel of 16-bit or float numbers.
        scale: Stored value of one metre.
    """
    if path.suffix.lower() == ".npy":
        return metres(_numpy_array(path), scale)
    if path.suffix.lower() == ".exr":
        return metres(_exr_channel(path), scale)
    return metres(decode_depth(path, (np.uint16, np.float32, np.float64)), scale)


def metres(raw: np.ndarray, scale: float) -> np.ndarray:
    """Stored depth as metres; NaN, infinities, negative values and 65535 in 16 bits become 0
    (missing), float32."""
    depth_m = raw.astype(np.float32) * np.float32(1.0 / scale)
    if raw.dtype == np.uint16:
        depth_m[raw == _LARGEST_OF_16_BITS] = 0.0
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m


def find_depth(folder: Path, stem: str) -> Path:
    """Depth file of the colour image ``stem``: the same name with any known suffix. The file may be
    missing."""
    candidates = (folder / f"{stem}{s}" for s in DEPTH_SUFFIXES)
    return next((p for p in candidates if is_file(p)), folder / f"{stem}.png")


def read_array(path: Path, what: str) -> np.ndarray:
    """Numbers of a NumPy file, which take no more memory than the file."""
    with parsing(path, what):
        open_regular(path, what).close()
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))


def _numpy_array(path: Path) -> np.ndarray:
    with parsing(path, "a NumPy array of depth", BadFrameError):
        array = np.squeeze(read_array(path, "a NumPy array of depth"))
    if array.ndim != 2:
        raise BadFrameError(
            f"{path} must hold a depth image [H, W], got the shape {list(array.shape)}"
        )
    if array.dtype.kind not in "fui":
        raise BadFrameError(f"{path} must hold depth as numbers, got the type {array.dtype}")
    return array


def check_exr(path: Path) -> None:
    """Raise ``SequenceError`` if this is an OpenEXR file and the package that reads it is
    missing."""
    if path.suffix.lower() == ".exr" and importlib.util.find_spec("OpenEXR") is None:
        raise SequenceError(
            f"{path} is an OpenEXR file, which needs the package OpenEXR: pip install "
            "'gsfusion-nb[exr]', or pip install OpenEXR"
        )


def _exr_channel(path: Path) -> np.ndarray:
    check_exr(path)
    import OpenEXR  # pyright: ignore[reportMissingImports]

    check_image_size(read_image_bytes(path, "depth"), path, "depth")
    with parsing(path, "depth as OpenEXR", BadFrameError):
        _check_exr_values(OpenEXR.File(str(path), header_only=True).parts, path)
    with parsing(path, "depth as OpenEXR", BadFrameError), OpenEXR.File(str(path)) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    array = next(
        (channels[n] for n in ("Z", "Y", "R", "RGB", "RGBA") if n in channels),
        None,
    )
    if array is None:
        raise BadFrameError(
            f"{path} has the channels {', '.join(channels)}; expected depth in Z, Y or R"
        )
    return array if array.ndim == 2 else array[..., 0]


_EXR_VALUES = 4 * MAX_PIXELS
"""Numbers in an OpenEXR file, all parts and channels together: as many as the largest image in
RGBA."""


def _check_exr_values(parts: Sequence[Any], path: Path) -> None:
    """Raise ``BadFrameError`` before the pixels of all channels, equal ones of which take no room
    in a file, are unpacked."""
    n_values = 0
    for part in parts:
        low, high = part.header["dataWindow"]
        width = int(high[0]) - int(low[0]) + 1
        height = int(high[1]) - int(low[1]) + 1
        n_values += width * height * len(part.header["channels"])
    if n_values > _EXR_VALUES:
        raise BadFrameError(
            f"{path} claims {n_values:,} numbers in all its channels; expected a depth image of at "
            f"most {_EXR_VALUES:,}"
        )
