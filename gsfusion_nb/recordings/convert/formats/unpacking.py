"""How much memory the packed parts of a ROS bag may ask for.

``rosbags`` unpacks a chunk of bz2, lz4 or zstd into as much memory as it takes: 19 kB of bz2 are
2.6 GB of zeros. While a bag is open here, its unpackers stop at a limit.
"""

import bz2
import importlib
import importlib.util
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from ....errors import SequenceError
from ....files import LEAST_MEMORY_BYTES, MOST_MEMORY_PER_BYTE, parsing

_ZSTD = "compression.zstd" if importlib.util.find_spec("compression") else "backports.zstd"
"""Where Python's zstd is; of the package before Python 3.14."""


SLICE_BYTES = 16 << 20
"""Unpacked at once: an unpacker needs twice the memory of what it returns."""


def most_bytes(files: list[Path]) -> int:
    """How many bytes a chunk of a bag of these files may unpack to."""
    return max(
        LEAST_MEMORY_BYTES, MOST_MEMORY_PER_BYTE * sum(file.stat().st_size for file in files)
    )


def unpack(
    data: bytes,
    make: Callable[[], Any],
    at_most: int,
    source: str | Path,
) -> bytes:
    """Unpacked content of one or more streams behind each other.

    Args:
        data: Packed.
        make: Makes the object that unpacks a stream, with ``decompress(data, max_length)``,
            ``eof``, ``needs_input``, ``unused_data``.
        at_most: Bytes that it may unpack to.
        source: Name for messages.

    Raises:
        SequenceError: it unpacks to more, or is truncated.
    """
    parts = []
    rest = data
    size = 0
    while rest:
        unpacker = make()
        block = rest
        while not unpacker.eof:
            part = unpacker.decompress(block, min(SLICE_BYTES, at_most - size + 1))
            block = b""
            size += len(part)
            if size > at_most:
                raise SequenceError(
                    f"{source}: {len(data)} packed bytes unpack to more than "
                    f"{at_most / 1e6:.0f} MB; expected at most {MOST_MEMORY_PER_BYTE} times the "
                    "size of the bag"
                )
            if not part and not unpacker.eof and unpacker.needs_input:
                raise SequenceError(f"{source}: a packed part of it is truncated; copy it again")
            parts.append(part)
        rest = unpacker.unused_data or b""
    return b"".join(parts)


@contextmanager
def bounded(source: Path, at_most: int) -> Iterator[None]:
    """A block in which ``rosbags`` unpacks nothing to more than ``at_most`` bytes."""
    lz4 = importlib.import_module("lz4.frame")
    zstd = importlib.import_module(_ZSTD)
    bag1, bag2, mcap = (
        importlib.import_module(f"rosbags.{name}")
        for name in ("rosbag1.reader", "rosbag2.reader", "rosbag2.storage_mcap")
    )

    def of_bz2(data: bytes) -> bytes:
        return unpack(data, bz2.BZ2Decompressor, at_most, source)

    def of_lz4(data: bytes) -> bytes:
        return unpack(data, lz4.LZ4FrameDecompressor, at_most, source)

    def of_zstd(data: bytes) -> bytes:
        return unpack(data, zstd.ZstdDecompressor, at_most, source)

    @contextmanager
    def whole_file(file: Any, mode: str) -> Iterator[Any]:
        with zstd.open(file, mode) as stream:
            yield _Counted(stream, at_most, source)

    chunks = {"lz4": lambda data, _: of_lz4(data), "zstd": lambda data, _: of_zstd(data)}
    with ExitStack() as stack:
        stack.enter_context(mock.patch.dict(bag1.decompressors, {"bz2": of_bz2, "lz4": of_lz4}))
        stack.enter_context(mock.patch.dict(mcap.DECOMPRESSORS, chunks))
        stack.enter_context(
            mock.patch.object(bag2, "zstd", SimpleNamespace(decompress=of_zstd, open=whole_file))
        )
        yield


class _Counted:
    """A file that ends with an error once it has given too much."""

    def __init__(self, file: Any, at_most: int, source: Path):
        self._file = file
        self._left = at_most
        self._source = source

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(min(size, self._left + 1) if size >= 0 else self._left + 1)
        self._left -= len(data)
        if self._left < 0:
            raise SequenceError(
                f"{self._source} unpacks to more than {MOST_MEMORY_PER_BYTE} times its size"
            )
        return data


_TABLES = ("messages", "topics", "schema", "metadata", "message_definitions")


def check_tables(path: Path) -> None:
    """Check that a ROS 2 bag in sqlite stores its rows.

    A view, a virtual table or a generated column makes rows when it is read, as many and as long as
    it likes.

    Raises:
        SequenceError: it has one of these, or is no such file.
    """
    with (
        parsing(path, "a ROS 2 bag in sqlite"),
        closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as bag,
    ):
        bag.execute("PRAGMA trusted_schema = OFF")
        for kind, name, text in bag.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            if kind in ("view", "trigger") or " virtual " in f"{text or ''} ".lower():
                raise SequenceError(
                    f"{path} has the {kind} {name!r}, which stores nothing; expected only tables"
                )
        for name in _TABLES:
            for column in bag.execute(f"PRAGMA table_xinfo({name})").fetchall():
                if column[-1] in (2, 3):
                    raise SequenceError(
                        f"{path} computes the column {column[1]!r} of {name}; expected stored "
                        "values"
                    )
