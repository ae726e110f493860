"""Images of the room that were made before, in a folder of the cache."""

import functools
import io
import logging
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy import ndarray

from ...errors import ArgumentError
from ...files import atomic_file, read_bytes

log = logging.getLogger(__name__)


def cached(
    path: Path | None,
    make: Callable[[], dict[str, ndarray]],
    fits: Callable[[dict[str, ndarray]], bool] = bool,
) -> dict[str, ndarray]:
    """The arrays of the archive ``path``; made and stored where it is absent or damaged, or its
    arrays do not fit.

    Two processes may store the same file at once: each writes its own temporary file, and the last
    one moved is kept. Without a path nothing is stored.
    """
    entry = _load(path) if path else None
    if entry is None or not fits(entry):
        entry = make()
        if path:
            _store(path, entry)
    return entry


def _store(path: Path, arrays: dict[str, ndarray]) -> None:
    """Save arrays in one archive with checksums, uint8 and uint16 ones as PNGs; failing to write is
    only logged."""

    def encoded(v: ndarray) -> ndarray:
        is_image = v.dtype in (np.uint8, np.uint16)
        return cv2.imencode(".png", v, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1] if is_image else v

    try:
        with atomic_file(path) as temporary:
            np.savez(
                temporary,
                allow_pickle=False,
                **{k: encoded(v) for k, v in arrays.items()},
            )
    except OSError as e:
        _warn_once(str(path.parent), str(e))


@functools.cache
def _warn_once(folder: str, reason: str) -> None:
    log.warning("cannot write to the cache folder %s: %s", folder, reason)


def _load(path: Path) -> dict[str, ndarray] | None:
    """Arrays written by ``_store``; None where they are absent or damaged."""
    try:
        with np.load(io.BytesIO(read_bytes(path, "cached arrays")), allow_pickle=False) as archive:
            arrays: dict[str, Any] = {name: archive[name] for name in archive.files}
        arrays = {
            k: cv2.imdecode(v, cv2.IMREAD_UNCHANGED) if v.dtype == np.uint8 else v
            for k, v in arrays.items()
        }
        if any(v is None for v in arrays.values()):
            raise ArgumentError("a picture is not a PNG")
        return arrays
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, cv2.error) as e:
        log.warning("%s is damaged and will be made again: %s", path, e)
        return None
