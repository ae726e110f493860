"""Files and folders that are whole or not there: made beside their place, then renamed into it."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import FetchError


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is never seen half written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, work: Path, *, keep: bool = False) -> Iterator[Path]:
    """A folder in ``work`` to fill, which takes the place of ``path`` when the block ends without an exception.

    After an exception, Ctrl-C included, it is removed, or with ``keep`` left to go on from; what a killed program left
    is removed at the next start. It has the name that ``path`` will have. ``work`` must be on the same disk.

    Raises:
        FetchError: ``path`` exists.
    """
    if path.exists():
        raise FetchError(f"{path} is there already; remove or rename it to make it anew")
    place = work / "unfinished" / path.name
    if not keep and place.exists():
        shutil.rmtree(place)
    place.mkdir(parents=True, exist_ok=True)
    done = False
    try:
        yield place
        path.parent.mkdir(parents=True, exist_ok=True)
        os.rename(place, path)
        done = True
    finally:
        if not done and not keep:
            shutil.rmtree(place, ignore_errors=True)
