"""Files and folders that appear under their name only when they are complete, and where cached files are kept.

A complete file is written under a temporary name in the same folder, flushed to disk and renamed, which every file
system does in one step. So a reader finds the old content or the new one, also after a crash or a power failure. A
killed program may leave a temporary file, which is never read.
"""

import contextlib
import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of ``path`` when the block ends without an exception.

    The temporary file is in the same folder (created if needed) and has the same suffix. After an exception, Ctrl-C
    included, it is removed, and a previous file at ``path`` is unchanged.

        with atomic_file("run/map.npz") as temporary:
            np.savez(temporary, xyz=xyz)

    Raises:
        FileNotFoundError: the block wrote nothing to the temporary path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(
                f"nothing was written for {path}; expected the block to write to the path it was given"
            )
        move_into_place(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_file(path: str | Path, content: bytes | str) -> None:
    """Write a whole file at once (``atomic_file``); text is encoded as UTF-8."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_folder(path: Path, temporary: Path, *, resume: bool = False) -> Iterator[Path]:
    """The folder ``temporary`` to fill, which becomes ``path`` when the block ends without an exception.

    After an exception, Ctrl-C included, it is removed; what a killed program left there is removed at the next start.

    Args:
        path: Folder to make.
        temporary: Where to fill it, on the same disk.
        resume: Keep the unfinished folder after an exception, and continue with what an earlier call left there.

    Raises:
        FileExistsError: ``path`` exists.
    """
    if path.exists():
        raise FileExistsError(f"{path} already exists; remove or rename it to make it again")
    if temporary.exists() and not resume:
        shutil.rmtree(temporary)
    temporary.mkdir(parents=True, exist_ok=True)
    done = False
    try:
        yield temporary
        path.parent.mkdir(parents=True, exist_ok=True)
        move_into_place(temporary, path)
        done = True
    finally:
        if not done and not resume:
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
