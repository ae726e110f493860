"""Hashes of the content of files, kept in the cache folder."""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from .atomic import write_file


def cache_folder() -> Path:
    """``$GSFUSION_CACHE``, or the folder ``gsfusion_nb`` in the place that the system has for
    caches."""
    if folder := os.environ.get("GSFUSION_CACHE"):
        return Path(folder).expanduser()
    return user_cache_path("gsfusion_nb", appauthor=False, opinion=False)


_SETTLED_NS = 2_000_000_000
"""Ticks of file systems are at most this long (FAT)."""
_LONG_BYTES = 1 << 30
"""Hashing more than this shows a bar."""
UNREADABLE = "missing, or cannot be read"
"""In place of the hash of such a file."""


def file_hashes(files: Iterable[str | Path]) -> dict[str, str]:
    """Path -> hash of the content of each file, 32 hexadecimal digits, or ``UNREADABLE``.

    Every file is hashed from its first byte to its last, links followed. The hashes are kept in the
    cache folder by path, size, times and inode, so that a file is hashed once. A file that was
    changed within the last two seconds is hashed again: a second change in the same tick of the
    file system's clock would not be seen.
    """
    marks = {path: _mark(path) for path in (os.path.abspath(file) for file in files)}
    tables = {folder: _Known(folder) for folder in dict.fromkeys(map(os.path.dirname, marks))}
    hash_of = {
        path: tables[os.path.dirname(path)].hash_of(path, mark) for path, mark in marks.items()
    }
    unhashed = [path for path, mark in marks.items() if mark and not hash_of[path]]
    is_long = sum(marks[path][0] for path in unhashed) > _LONG_BYTES
    from ..progress import ProgressDisplay

    with ProgressDisplay(
        "hashing the data", total=len(unhashed), unit="file", leave=False, visible=is_long
    ) as progress:
        for n, path in enumerate(unhashed, start=1):
            hash_of[path] = tables[os.path.dirname(path)].add(path, marks[path])
            progress.show(n)
    for folder in tables.values():
        folder.save()
    return {path: digest or UNREADABLE for path, digest in hash_of.items()}


class _Known:
    """Hashes of the files of one folder that are known from before: name -> size, times, inode and
    hash."""

    def __init__(self, folder: str):
        name = hashlib.blake2b(folder.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        self._path = cache_folder() / "hashes" / f"{name}.json"
        self._changed = False
        self._rows: dict[str, Any] = {}
        with contextlib.suppress(ValueError, OSError):  # none yet, or damaged: hashed again
            rows = json.loads(self._path.read_text(encoding="utf-8"))
            self._rows = rows if isinstance(rows, dict) else {}

    def hash_of(self, path: str, mark: tuple[int, ...]) -> str:
        """The hash of a file that is as it was; empty if it is not known."""
        stored_mark, _, digest = str(self._rows.get(os.path.basename(path), "")).rpartition(" ")
        return digest if mark and stored_mark == " ".join(map(str, mark)) else ""

    def add(self, path: str, mark: tuple[int, ...]) -> str:
        """Hash a file; the hash is kept, unless the file changed while it was read, or shortly
        before."""
        digest = _hash(path)
        if digest and mark == _mark(path) and time.time_ns() - max(mark[1:3]) > _SETTLED_NS:
            self._rows[os.path.basename(path)] = f"{' '.join(map(str, mark))} {digest}"
            self._changed = True
        return digest

    def save(self) -> None:
        """Write what is new; a cache that cannot be written only costs time."""
        if self._changed:
            with contextlib.suppress(OSError, ValueError):
                write_file(self._path, json.dumps(self._rows))


def _mark(path: str) -> tuple[int, ...]:
    """Size, times (nanoseconds) and inode of a file, or of the file that a link leads to; empty if
    there is none."""
    try:
        stat = os.stat(path)
    except (OSError, ValueError):
        return ()
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _hash(path: str) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except OSError:
        return ""
