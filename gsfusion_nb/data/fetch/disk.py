"""Checking free disk space before it is needed."""

import errno
import shutil
from pathlib import Path

from .errors import NoSpaceError

MARGIN_BYTES = 200_000_000
"""Space that must stay free for other users of the disk."""


def require_space(folder: Path, needed_bytes: int, what: str) -> None:
    """Raise ``NoSpaceError`` unless the disk of ``folder`` (which need not exist yet) has room for ``what``."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed_bytes + MARGIN_BYTES:
        raise NoSpaceError(
            f"{place} has {size_text(free)} free; {what} needs {size_text(needed_bytes)}, and "
            f"{size_text(MARGIN_BYTES)} must stay free: delete something, or choose another disk with --out"
        )


def full_disk(error: OSError, path: Path) -> NoSpaceError | None:
    """The message for a disk or quota that became full while ``path`` was written; None for another error."""
    if error.errno not in (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)):
        return None
    return NoSpaceError(f"the disk is full: {path} could not be written completely; free some space and run again")


def size_text(n_bytes: int) -> str:
    """A size as text, with 1 GB = 1,000 MB."""
    if n_bytes < 1_000_000:
        return f"{n_bytes / 1e3:.0f} kB" if n_bytes >= 1000 else f"{n_bytes} bytes"
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"
