"""Free disk space, checked before it is needed."""

import errno
import shutil
from pathlib import Path

from .errors import NoSpaceError

MARGIN_BYTES = 200_000_000
"""Left free for other users of the disk."""


def require_space(folder: Path, needed_bytes: int, what: str) -> None:
    """Raise ``NoSpaceError`` unless the disk of ``folder`` (which need not exist yet) has room for ``what``."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed_bytes + MARGIN_BYTES:
        raise NoSpaceError(
            f"{place} has {size_text(free)} free; {what} needs {size_text(needed_bytes)} and leaves "
            f"{size_text(MARGIN_BYTES)} for others: free some, or choose another disk with --out"
        )


def full_disk(error: OSError, path: Path) -> NoSpaceError | None:
    """The sentence for a disk or quota that filled up while ``path`` was written; None for another error."""
    if error.errno not in (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)):
        return None
    return NoSpaceError(f"the disk is full: {path} could not be written to its end; free some space and run again")


def size_text(n_bytes: int) -> str:
    """A size for people: 1 GB is a thousand MB."""
    if n_bytes < 1_000_000:
        return f"{n_bytes / 1e3:.0f} kB" if n_bytes >= 1000 else f"{n_bytes} bytes"
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"
