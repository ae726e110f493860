"""A file or folder is written completely or not at all.

A complete file is written under a temporary name in the same folder, flushed to disk and renamed,
which every file system does in one step. So a reader finds the old content or the new one, also
after a crash or a power failure. A killed program may leave a temporary file, which is never read
(``remove_partial``).
"""

import contextlib
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import DiskFullError

_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""No space, a file larger than allowed, a user's quota."""


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of ``path`` when the block ends without
    an exception.

    The temporary file is in the same folder (created if needed) and has the same suffix. After an
    exception, Ctrl-C included, it is removed, and a previous file at ``path`` is unchanged.

        with atomic_file("run/map.npz") as temporary:
            np.savez(temporary, xyz=xyz)

    Raises:
        FileNotFoundError: the block wrote nothing to the temporary path.
        DiskFullError: there is no room for the file; the previous one, if any, is unchanged.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(
                f"nothing was written for {path}; expected the block to write to the path it was "
                "given"
            )
        move_into_place(temporary, path)
    except OSError as e:
        if not _is_full(e):
            raise
        raise DiskFullError(
            e.errno or errno.ENOSPC, f"{path} cannot be written: {_why_no_room(e, path.parent)}"
        ) from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _why_no_room(error: OSError, folder: Path) -> str:
    """What leaves no room for a file in a folder, in words."""
    if error.errno == errno.EFBIG:
        most = _largest_file_bytes()
        if most is None:
            return "the file system of its folder takes no file that is so large"
        return (
            f"this process may write no file of more than {most / 1e6:.1f} MB (the limit "
            "RLIMIT_FSIZE of the system, in a shell: ulimit -f); `ulimit -f unlimited` lifts it"
        )
    free = f"{shutil.disk_usage(folder).free / 1e6:.1f} MB are free"
    if error.errno == getattr(errno, "EDQUOT", None):
        return f"the quota of this user is used up, though {free}"
    return f"the disk is full, {free}"


def _largest_file_bytes() -> int | None:
    """How large a file of this process may become; None: as large as the file system allows."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    return None if most == resource.RLIM_INFINITY else most


def remove_partial(folder: Path) -> None:
    """Remove the temporary files that a killed program left in ``folder``; nobody else may be
    writing there."""
    for path in folder.glob(".*.partial*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\.partial(\.\w+)?", path.name):
            path.unlink(missing_ok=True)


def write_file(path: str | Path, content: bytes | str) -> None:
    """Write a whole file at once (``atomic_file``); text is encoded as UTF-8."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_folder(path: Path, temporary: Path) -> Iterator[Path]:
    """The folder ``temporary`` to fill, which becomes ``path`` when the block ends without an
    exception.

    After an exception, Ctrl-C included, it is removed, and the folders above it that were made for
    it; what a killed program left there is removed at the next start.

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
    new_folders = [folder for folder in temporary.parents if not folder.exists()]
    temporary.mkdir(parents=True)
    try:
        yield temporary
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.rmdir()
        move_into_place(temporary, path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        for folder in new_folders:
            with contextlib.suppress(OSError):  # only one that is still empty goes
                folder.rmdir()
        raise
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


def _is_full(error: OSError) -> bool:
    # numpy says how much it could write, and no reason
    return error.errno in _FULL or (
        error.errno is None and re.search(r"requested and \d+ written", str(error)) is not None
    )


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
