"""Files that save work between runs. A file is whole or absent: it is written beside its place and moved in."""

import contextlib
import functools
import io
import logging
import os
import sys
import uuid
import zipfile
from pathlib import Path

import numpy as np
from numpy import ndarray

log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """``$GSFUSION_CACHE``, or the platform's place for caches."""
    if given := os.environ.get("GSFUSION_CACHE"):
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "gsfusion_nb"


def store(path: Path, **images: ndarray) -> None:
    """Save uint8 or uint16 images as PNGs in one archive with checksums; failing to write is only logged.

    Two processes may store the same file at once: each writes its own temporary one, and the last move wins.
    """
    import cv2

    temporary = path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        encoded = {k: cv2.imencode(".png", v, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1] for k, v in images.items()}
        with open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **encoded)
        os.replace(temporary, path)
    except OSError as e:
        _warn_once(str(path.parent), str(e))
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def load(path: Path) -> dict[str, ndarray] | None:
    """Images of an archive written by ``store``; None where it is absent or damaged."""
    import cv2

    images: dict[str, ndarray] = {}
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            for name in archive.files:
                image = cv2.imdecode(archive[name], cv2.IMREAD_UNCHANGED)
                if image is None:
                    raise ValueError(f"{name} is no PNG")
                images[name] = image
        return images
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, cv2.error) as e:
        log.warning("%s is damaged and is made anew: %s", path, e)
        return None


@functools.cache
def _warn_once(folder: str, reason: str) -> None:
    log.warning("nothing is cached in %s: %s", folder, reason)
