"""Files of other people and programs, opened and read within limits.

Such a file may be damaged, of another kind, or made to harm. So nothing here opens a pipe or a
device, which would wait or never end; nothing takes more memory than the caller allows; and
whatever a parser of another project raises becomes a ``SequenceError`` that names the file.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from ..errors import SequenceError, SequenceNotFoundError, reason_of

TEXT_BYTES = 256_000_000
"""Of a text file: the poses of a million frames."""
IMAGE_BYTES = 256_000_000
"""Of an encoded image."""
_noted: ContextVar[list[Path] | None] = ContextVar("noted", default=None)


def is_file(path: Path) -> bool:
    """Whether there is a file; False for a name, written by somebody else, that no file can
    have."""
    try:
        return path.is_file()
    except OSError:
        return False


@contextmanager
def noting_files() -> Iterator[list[Path]]:
    """A block in which every file that is opened by this module is added to the list that it
    gives."""
    paths = []
    outer = _noted.get()
    token = _noted.set(paths)
    try:
        yield paths
    finally:
        _noted.reset(token)
        if outer is not None:
            outer += paths


def open_regular(path: str | Path, what: str) -> BufferedReader:
    """Open a plain file for reading bytes. Pipes, sockets, devices and folders are refused, before
    anything waits.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no plain file, or it may not be read.
    """
    try:
        # A pipe that nobody writes to blocks on opening, unless it is opened without waiting.
        handle = os.open(
            path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        )
    except (FileNotFoundError, NotADirectoryError):
        raise SequenceNotFoundError(f"{path} does not exist; expected {what}") from None
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or e
        if os.path.isdir(path):
            reason = "it is a folder"
        raise SequenceError(f"{path} cannot be read ({reason}); expected {what}") from None
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or device"
        raise SequenceError(f"{path} is {kind}, not a plain file; expected {what}")
    notes = _noted.get()
    if notes is not None:
        notes.append(Path(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> bytes:
    """Content of a plain file (``open_regular``) of at most ``at_most`` bytes."""
    with open_regular(path, what) as file:
        try:
            data = file.read(at_most + 1)
        except OSError as e:
            raise SequenceError(f"{path} cannot be read ({e.strerror}); expected {what}") from None
    if len(data) > at_most:
        raise SequenceError(f"{path} is larger than {at_most / 1e6:g} MB; expected {what}")
    return data


def read_text(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> str:
    """Text of a plain file in UTF-8, with or without a byte order mark."""
    try:
        return read_bytes(path, what, at_most=at_most).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SequenceError(f"{path} is not a text file; expected {what}") from None


def read_exactly(file: BinaryIO, n: int, path: str | Path) -> bytes:
    """The next ``n`` bytes of an open file.

    Raises:
        SequenceError: it has fewer; nothing is read then, so a length that is wrong costs no
            memory.
    """
    n_left = os.fstat(file.fileno()).st_size - file.tell()
    if not 0 <= n <= n_left:
        raise SequenceError(
            f"{path} is truncated: it ends {n - n_left} bytes too early; copy it again"
        )
    return file.read(n)


@contextmanager
def parsing(
    source: str | Path, what: str, error: type[SequenceError] = SequenceError
) -> Iterator[None]:
    """Whatever a parser of another project raises in the block becomes one sentence that names
    ``source``.

    Such parsers were written for files in order: from a damaged one follows any exception, such as
    ``struct.error`` or ``AssertionError``. Errors that are sentences already pass as they are.
    """
    try:
        yield
    except SequenceError:
        raise
    except MemoryError:
        raise error(
            f"{source} asks for more memory than there is; it is damaged; expected {what}"
        ) from None
    except Exception as e:
        raise error(
            f"{source} is not readable as {what} ({reason_of(e)}); it may be truncated or damaged"
        ) from e
