"""Limits for what the package rosbags reads of a bag, and for what the chunks of a bag unpack to; rosbags has none."""

import bz2
import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ....data.sequence import SequenceError
from ....files import free_space
from ....foreign import open_regular, parsing

MAX_CHUNK_BYTES = 256_000_000
"""Of one chunk unpacked; recorders begin a new one after 0.75 to 4 MB, or after one large message."""
MAX_RATIO = 100
"""Bytes of an unpacked file divided by those of the packed one, at most; images are about 2, text is 10."""
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


def check_packed_files(folder: Path) -> None:
    """Raise ``SequenceError`` for a packed file of a ROS 2 bag that unpacks to more than there is room for.

    rosbags unpacks the files of a bag with ``compression_mode: file`` to the folder for temporary files. Here each is
    unpacked once before, without keeping anything.
    """
    free = free_space(Path(tempfile.gettempdir()))
    for path in sorted(folder.glob("*.zstd")):
        limit = min(free, MAX_RATIO * path.stat().st_size)
        with open_regular(path, "a packed file of a ROS bag") as packed, parsing(path, "a file packed with zstd"):
            unpacked, stream = 0, _zstd_module().ZstdFile(packed)
            while block := stream.read(1 << 20):
                unpacked += len(block)
                if unpacked > limit:
                    raise SequenceError(
                        f"{path} unpacks to more than {limit / 1e6:.0f} MB, {MAX_RATIO} times its size or all the free "
                        "space for temporary files; unpack it with zstd -d first, if it is not made to harm"
                    )
        free -= unpacked


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
    return _zstd_module().ZstdDecompressor()


def _zstd_module() -> Any:
    try:
        from compression import zstd  # pyright: ignore[reportMissingImports]
    except ImportError:
        from backports import zstd  # pyright: ignore[reportMissingImports]
    return zstd


_STREAMS: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": _lz4, "zstd": _zstd}
"""Unpackers that can stop, by the name that a bag gives its packing."""
