"""Where numba keeps compiled kernels: where it wants to, else in the toolkit's cache, else in a
temporary folder.

Numba keeps them beside their sources, or in the user's own cache. In a container whose packages are
read-only and whose user has no home both fail, and numba then refuses to make a function that is to
be kept.
"""

import contextlib
import logging
import os
import tempfile
from pathlib import Path

from numba.core import config
from numba.misc.appdirs import AppDirs

from gsfusion_nb.files import cache_folder

log = logging.getLogger(__name__)

_KERNELS = Path(__file__).parents[2]


def choose_place() -> str:
    """Where compiled kernels go if not where numba wants them; empty where it can have its way.

    The folder is made, belongs to the user alone, and is set in numba's configuration.
    """
    if config.CACHE_DIR:  # pyright: ignore[reportAttributeAccessIssue]
        return ""
    of_numba = (
        _KERNELS / "__pycache__",
        Path(AppDirs(appname="numba", appauthor=False).user_cache_dir),
    )
    if any(_is_writable(folder) for folder in of_numba):
        return ""
    place = next(
        (folder for folder in _own_places() if _is_writable(folder) and _is_own(folder)), None
    )
    if place is None:
        return ""
    log.warning(
        "compiled kernels are kept in %s, since neither the package nor a home can be written",
        place,
    )
    config.CACHE_DIR = str(place)  # pyright: ignore[reportAttributeAccessIssue]
    return str(place)


def _own_places() -> tuple[Path, ...]:
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return cache_folder() / "kernels", Path(
        tempfile.gettempdir()
    ) / f"gsfusion_nb-{user}" / "kernels"


def _is_writable(folder: Path) -> bool:
    """Whether a file can be made in a folder, which is made if it is not there."""
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder):
            return True
    return False


def _is_own(folder: Path) -> bool:
    """Whether nobody else can put machine code into a folder for this user to run."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022
