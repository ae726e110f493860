"""Files and folders that appear under their name only when they are complete, the cache folder, and hashes of files.

A complete file is written under a temporary name in the same folder, flushed to disk and renamed, which every file
system does in one step. So a reader finds the old content or the new one, also after a crash or a power failure. A
killed program may leave a temporary file, which is never read (``remove_partial``)."""

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""No space, a file larger than allowed, a user's quota."""


class DiskFullError(OSError):
    """There is no room for a file; the message names it, what it needs and what is free."""

    def __str__(self) -> str:
        return str(self.args[1])


@contextmanager
def atomic_file(path: str | Path, *, size_bytes: int = 0) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of ``path`` when the block ends without an exception.

    The temporary file is in the same folder (created if needed) and has the same suffix. After an exception, Ctrl-C
    included, it is removed, and a previous file at ``path`` is unchanged.

        with atomic_file("run/map.npz") as temporary:
            np.savez(temporary, xyz=xyz)

    Args:
        path: Where the file will be.
        size_bytes: How large it will be, where that is known: the space is checked first.

    Raises:
        FileNotFoundError: the block wrote nothing to the temporary path.
        DiskFullError: there is no room for the file; the previous one, if any, is unchanged.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    check_space(path, size_bytes)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(
                f"nothing was written for {path}; expected the block to write to the path it was given"
            )
        move_into_place(temporary, path)
    except OSError as e:
        if not _is_full(e):
            raise
        raise DiskFullError(e.errno or errno.ENOSPC, _no_room(path, max(size_bytes, _size(temporary)), e)) from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove the temporary files that a killed program left in ``folder``; nobody else may be writing there."""
    for path in folder.glob(".*.partial*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\.partial(\.\w+)?", path.name):
            path.unlink(missing_ok=True)


def check_space(path: Path, size_bytes: int) -> None:
    """Raise ``DiskFullError`` if a file of ``size_bytes`` does not fit beside ``path``."""
    if size_bytes and free_space(path.parent) < size_bytes:
        raise DiskFullError(errno.ENOSPC, _no_room(path, size_bytes, None))


def free_space(folder: Path) -> int:
    """Bytes that can still be written to the disk of ``folder``; a very large number where the system does not say."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return sys.maxsize


def write_file(path: str | Path, content: bytes | str) -> None:
    """Write a whole file at once (``atomic_file``); text is encoded as UTF-8."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_folder(path: Path, temporary: Path) -> Iterator[Path]:
    """The folder ``temporary`` to fill, which becomes ``path`` when the block ends without an exception.

    After an exception, Ctrl-C included, it is removed; what a killed program left there is removed at the next start.

    Args:
        path: Folder to make; an empty one may be there.
        temporary: Where to fill it, on the same disk.

    Raises:
        FileExistsError: ``path`` exists and is not an empty folder.
    """
    if path.exists() and not (path.is_dir() and next(path.iterdir(), None) is None):
        raise FileExistsError(f"{path} already exists; expected the name of a new or empty folder")
    if temporary.exists():
        shutil.rmtree(temporary)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.rmdir()
        move_into_place(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def move_into_place(temporary: Path, path: Path) -> None:
    """Flush a complete file or folder to disk and rename it to ``path``, on the same disk.

    A file at ``path`` is replaced; a folder there must be empty.
    """
    if temporary.is_dir():
        for root, _, names in os.walk(temporary, topdown=False):
            for name in names:
                _flush(Path(root, name))
            _flush_folder(Path(root))
    else:
        _flush(temporary)
    os.replace(temporary, path)
    _flush_folder(path.parent)


def try_lock(handle: int) -> bool:
    """Lock an open file for this process, unless another one holds it; whether it is locked now.

    The operating system frees the lock when the file is closed or its holder ends, however it ends.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def cache_folder() -> Path:
    """``$GSFUSION_CACHE``, or the folder ``gsfusion_nb`` in the place that the system has for caches."""
    if given := os.environ.get("GSFUSION_CACHE"):
        return Path(given).expanduser()
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "gsfusion_nb"


def _is_full(error: OSError) -> bool:
    # numpy says how much it could write, and no reason
    return error.errno in _FULL or (
        error.errno is None and re.search(r"requested and \d+ written", str(error)) is not None
    )


def _no_room(path: Path, size_bytes: int, error: OSError | None) -> str:
    why = (
        "a file may not be that large here" if error is not None and error.errno == errno.EFBIG else "the disk is full"
    )
    free = free_space(path.parent)
    has = "" if free == sys.maxsize else f", {free / 1e6:.1f} MB are free"
    return f"{path} cannot be written: {why}; it needs at least {size_bytes / 1e6:.1f} MB{has}"


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _flush(file: Path) -> None:
    # Windows flushes only what is open for writing; elsewhere a read-only file must be flushed too.
    handle = os.open(file, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _flush_folder(folder: Path) -> None:
    """Flush the names in a folder, where the system can: Windows and some network disks cannot."""
    with contextlib.suppress(OSError):
        _flush(folder)


_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""First characters that make a spreadsheet compute a cell."""


def plain_cell(text: str) -> str:
    """Text on one line that a spreadsheet shows and does not compute."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line.lstrip().startswith(_FORMULAS) or text.startswith(_FORMULAS) else line


_SETTLED_NS = 2_000_000_000
"""Ticks of file systems are at most this long (FAT)."""
_LONG_BYTES = 1 << 30
"""Hashing more than this shows a bar."""
UNREADABLE = "missing, or cannot be read"
"""In place of the hash of such a file."""


def file_hashes(files: Iterable[str | Path]) -> dict[str, str]:
    """Path -> hash of the content of each file, 32 hexadecimal digits, or ``UNREADABLE``.

    Every file is hashed from its first byte to its last, links followed. The hashes are kept in the cache folder by
    path, size, times and inode, so that a file is hashed once. A file that was changed within the last two seconds is
    hashed again: a second change in the same tick of the file system's clock would not be seen.
    """
    marks = {path: _mark(path) for path in (os.path.abspath(file) for file in files)}
    known = {folder: _Known(folder) for folder in dict.fromkeys(map(os.path.dirname, marks))}
    found = {path: known[os.path.dirname(path)].hash_of(path, mark) for path, mark in marks.items()}
    left = [path for path, mark in marks.items() if mark and not found[path]]
    is_long = sum(marks[path][0] for path in left) > _LONG_BYTES
    from .work import ProgressDisplay

    with ProgressDisplay("hashing the data", total=len(left), unit="file", leave=False, shown=is_long) as progress:
        for n, path in enumerate(left, start=1):
            found[path] = known[os.path.dirname(path)].add(path, marks[path])
            progress.show(n)
    for folder in known.values():
        folder.save()
    return {path: digest or UNREADABLE for path, digest in found.items()}


class _Known:
    """Hashes of the files of one folder that are known from before: name -> size, times, inode and hash."""

    def __init__(self, folder: str):
        name = hashlib.blake2b(folder.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        self._path, self._changed = cache_folder() / "hashes" / f"{name}.json", False
        self._rows: dict[str, Any] = {}
        with contextlib.suppress(ValueError, OSError):  # none yet, or damaged: hashed again
            rows = json.loads(self._path.read_text(encoding="utf-8"))
            self._rows = rows if isinstance(rows, dict) else {}

    def hash_of(self, path: str, mark: tuple[int, ...]) -> str:
        """The hash of a file that is as it was; empty if it is not known."""
        then, _, digest = str(self._rows.get(os.path.basename(path), "")).rpartition(" ")
        return digest if mark and then == " ".join(map(str, mark)) else ""

    def add(self, path: str, mark: tuple[int, ...]) -> str:
        """Hash a file; the hash is kept, unless the file changed while it was read, or shortly before."""
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
    """Size, times (nanoseconds) and inode of a file, or of the file that a link leads to; empty if there is none."""
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
