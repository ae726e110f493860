"""The folder for unfinished data sets, beside the finished ones; used by one program at a time."""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from ...files import atomic_folder, try_lock
from .errors import FetchError

WORK = ".fetch"
"""Its name in the folder of all data sets: archives, partial downloads, unfinished data sets."""


@contextmanager
def only_one(out: Path) -> Iterator[None]:
    """Lock the work folder in ``out``. The operating system releases the lock when the program ends, in any way.

    Raises:
        FetchError: another program has locked it.
    """
    folder = out / WORK
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if not try_lock(handle):
            raise FetchError(f"another program is fetching into {folder}; wait for it, or choose another --out")
        yield
    finally:
        os.close(handle)


def unfinished_folder(target: Path, out: Path, *, resume: bool = False) -> AbstractContextManager[Path]:
    """A folder to fill, which is renamed to ``target`` when it is complete (``atomic_folder``)."""
    return atomic_folder(target, out / WORK / "unfinished" / target.name, resume=resume)
