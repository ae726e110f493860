"""Rendered images and textures of the room, stored in the cache folder for later runs."""

import contextlib
import functools
import io
import logging
import os
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy import ndarray

from ...files import atomic_file, try_lock
from ...foreign import read_bytes

log = logging.getLogger(__name__)

WAIT_S = 120.0
"""A process that holds a lock longer than this has probably been stopped; the others then do its work, too."""
_POLL_S = 0.1


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


@contextlib.contextmanager
def one_process_at_a_time(path: Path) -> Iterator[None]:
    """Hold a lock beside ``path``: of several processes that need the same file one makes it, and the others wait.

    Without a folder that can be written to there is no lock, because nothing can be stored for the others.
    """
    with contextlib.ExitStack() as closing:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o644)
            closing.callback(os.close, handle)
            until = time.monotonic() + WAIT_S
            while not try_lock(handle) and time.monotonic() < until:
                time.sleep(_POLL_S)
        yield


@functools.cache
def _warn_once(folder: str, reason: str) -> None:
    log.warning("cannot write to the cache folder %s: %s", folder, reason)
