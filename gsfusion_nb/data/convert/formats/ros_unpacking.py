"""Limits for what the package rosbags reads of a bag, and for what the chunks of a bag unpack to; rosbags has none."""

import bz2
import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ....foreign import open_regular
from ...sequence import SequenceError

MAX_CHUNK_BYTES = 256_000_000
"""Of one chunk unpacked; recorders begin a new one after 0.75 to 4 MB, or after one large message."""
_LARGE_BYTES = 1 << 20


class BagPath(type(Path())):
    """A path whose file gives no more bytes than it has, also where a damaged bag asks for four gigabytes.

    Python's own files first take the memory that is asked for, and then see how much there is.
    """

    def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
        """Of a plain file only, if it is for reading bytes."""
        if mode != "rb":
            return super().open(mode, *args, **options)
        return _BagFile(open_regular(self, "a file of a ROS bag").detach())


class _BagFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _LARGE_BYTES:
            size = max(0, min(size, os.fstat(self.fileno()).st_size - self.tell()))
        return super().read(size)


@contextlib.contextmanager
def bounded_unpacking() -> Iterator[None]:
    """Within the block no chunk of a bag unpacks to more than ``MAX_CHUNK_BYTES``.

    rosbags 0.10 and 0.11 keep their unpackers in two dictionaries by name, and offer no limit.
    """
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import storage_mcap

    before = [(d, dict(d)) for d in (_unpackers(rosbag1), _unpackers(storage_mcap))]
    for unpackers, old in before:
        unpackers |= {name: _bounded(name, old[name]) for name in old if name in _STREAMS}
    try:
        yield
    finally:
        for unpackers, old in before:
            unpackers |= old


def _unpackers(module: Any) -> dict[str, Callable[..., bytes]]:
    """The module's dictionary of unpackers by name, whatever it is called."""
    found = (v for v in vars(module).values() if isinstance(v, dict) and {"lz4"} <= set(v))
    return next(found, {})


def _bounded(name: str, unpack: Callable[..., bytes]) -> Callable[..., bytes]:
    def bounded(data: bytes, *size: int) -> bytes:
        content = _STREAMS[name]().decompress(bytes(data), MAX_CHUNK_BYTES + 1)
        if len(content) > MAX_CHUNK_BYTES:
            raise SequenceError(
                f"a chunk of the bag unpacks to more than {MAX_CHUNK_BYTES / 1e6:g} MB; it may be a decompression bomb"
            )
        return content

    return bounded


def _lz4() -> Any:
    from lz4.frame import LZ4FrameDecompressor

    return LZ4FrameDecompressor()


def _zstd() -> Any:
    try:
        from compression import zstd  # pyright: ignore[reportMissingImports]
    except ImportError:
        from backports import zstd  # pyright: ignore[reportMissingImports]
    return zstd.ZstdDecompressor()


_STREAMS: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": _lz4, "zstd": _zstd}
"""Unpackers that can stop, by the name that a bag gives its packing."""
