"""Packed content, which takes no more memory than the caller allows."""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BadFrameError, SequenceError, reason_of
from .foreign import open_regular, parsing

LEAST_MEMORY_BYTES = 1 << 29
MOST_MEMORY_PER_BYTE = 100
"""A packed file of ours may take as much memory as the first, or as many times its size as the
second: the TSDFs of runs take 8 to 16 times the size of their files, and files that are made to
harm a thousand times and more."""


def check_memory(path: Path, n_bytes: int, what: str) -> None:
    """Raise ``SequenceError`` before a file, expected to be ``what``, takes far more memory than
    one of its size can hold."""
    size = path.stat().st_size
    if n_bytes > max(LEAST_MEMORY_BYTES, MOST_MEMORY_PER_BYTE * size):
        raise SequenceError(
            f"{path} of {size / 1e6:.1f} MB asks for {n_bytes / 1e9:.1f} GB of memory, more than "
            f"{MOST_MEMORY_PER_BYTE} times its size; expected {what}"
        )


@contextmanager
def open_arrays(path: Path, what: str) -> Iterator[Any]:
    """The arrays of an ``.npz`` file of ours, expected to be ``what``, as ``np.load`` gives them
    (``NpzFile``). Nothing in the file is executed, and it takes no more memory than its size
    allows.

    Raises:
        FileNotFoundError: no such file. SequenceError: another file, a damaged one, or any error
            while its arrays are read.
    """
    with (
        open_regular(path, what) as file,
        parsing(path, what),
        np.load(file, allow_pickle=False) as arrays,
    ):
        check_memory(path, sum(entry.file_size for entry in arrays.zip.infolist()), what)
        yield arrays


def inflate(data: bytes, source: str | Path, *, at_most: int) -> bytes:
    """Unpacked content of a zlib stream. Raises ``BadFrameError`` when it is damaged or larger than
    ``at_most``."""
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, at_most + 1)
    except zlib.error as e:
        raise BadFrameError(f"{source} cannot be unpacked ({e})") from None
    if len(content) > at_most:
        raise BadFrameError(f"{source} unpacks to more than the {at_most} bytes that were expected")
    if not unpacker.eof:
        raise BadFrameError(f"{source} cannot be unpacked (it is truncated)")
    return content


def open_archive(path: str | Path, what: str) -> zipfile.ZipFile:
    """A zip archive for reading. Raises ``SequenceError`` for another file."""
    open_regular(path, what).close()
    with parsing(path, what):
        return zipfile.ZipFile(path)


def read_member(
    archive: zipfile.ZipFile,
    name: str,
    source: str | Path,
    *,
    at_most: int,
) -> bytes:
    """Content of one member of an archive, of at most ``at_most`` bytes unpacked.

    Raises:
        KeyError: no such member. BadFrameError: it is damaged, encrypted or larger.
    """
    info = archive.getinfo(name)
    if info.file_size > at_most:
        raise BadFrameError(
            f"{source}: {name} unpacks to {info.file_size} bytes; expected at most {at_most}"
        )
    try:
        with archive.open(info) as member:
            return member.read(at_most)
    except Exception as e:
        raise BadFrameError(f"{source}: {name} is damaged ({reason_of(e)})") from None
