"""Rendered images and textures of the room, stored in the cache folder for later runs."""

import functools
import io
import logging
import zipfile
from pathlib import Path

import numpy as np
from numpy import ndarray

from ...files import atomic_file
from ...foreign import read_bytes

log = logging.getLogger(__name__)


def store(path: Path, **arrays: ndarray) -> None:
    """Save arrays in one archive with checksums, uint8 and uint16 ones as PNGs; failing to write is only logged.

    Two processes may store the same file at once: each writes its own temporary file, and the last one moved is kept.
    """
    import cv2

    def encoded(v: ndarray) -> ndarray:
        is_image = v.dtype in (np.uint8, np.uint16)
        return cv2.imencode(".png", v, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1] if is_image else v

    try:
        with atomic_file(path) as temporary:
            np.savez(temporary, allow_pickle=False, **{k: encoded(v) for k, v in arrays.items()})
    except OSError as e:
        _warn_once(str(path.parent), str(e))


def load(path: Path) -> dict[str, ndarray] | None:
    """Arrays of an archive written by ``store``; None where it is absent or damaged."""
    import cv2

    arrays: dict[str, ndarray] = {}
    try:
        with np.load(io.BytesIO(read_bytes(path, "cached arrays")), allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if array.dtype == np.uint8:
                    array = cv2.imdecode(array, cv2.IMREAD_UNCHANGED)
                    if array is None:
                        raise ValueError(f"{name} is not a PNG")
                arrays[name] = array
        return arrays
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, cv2.error) as e:
        log.warning("%s is damaged and will be made again: %s", path, e)
        return None


@functools.cache
def _warn_once(folder: str, reason: str) -> None:
    log.warning("cannot write to the cache folder %s: %s", folder, reason)
