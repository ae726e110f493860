"""Unpacking a tar, gzipped or not: read once from front to back, so that an archive of any size needs little memory."""

import gzip
import tarfile
import zlib
from collections.abc import Iterator

from ....errors import shown
from ....foreign import open_regular
from ..disk import require_space
from ..errors import ArchiveError
from .unpacker import Readable, Unpacker

MAX_HEADER_BYTES = 1 << 20
"""Limit for the headers of one member: tarfile holds them in memory, and a small gzipped file can contain gigabytes of
them."""

_SPACE_EVERY_BYTES = 200_000_000
_GZIP = b"\x1f\x8b"


class _Counted:
    """A stream that counts the bytes read and raises an error for a header that is too long."""

    def __init__(self, stream: Readable, name: str):
        self._stream, self._name = stream, name
        self.header_left: int | None = MAX_HEADER_BYTES

    def read(self, size: int) -> bytes:
        block = self._stream.read(size)
        if self.header_left is not None:
            self.header_left -= len(block)
            if self.header_left < 0:
                raise ArchiveError(
                    f"{self._name} holds a header of more than {MAX_HEADER_BYTES} bytes; it may be a decompression bomb"
                )
        return block


def unpack_tar(unpacker: Unpacker) -> None:
    """Unpack a tar, gzipped or not. Raises ``ArchiveError``, ``NoSpaceError``."""
    name = unpacker.archive.name
    with open_regular(unpacker.archive, "an archive") as raw:
        zipped = raw.read(2) == _GZIP
        raw.seek(0)
        stream = gzip.GzipFile(fileobj=raw) if zipped else raw
        try:
            counted = _Counted(stream, name)
            with tarfile.open(fileobj=counted, mode="r|") as tar:  # pyright: ignore[reportCallIssue, reportArgumentType]
                for member in _members(tar, counted):
                    _take(unpacker, tar, member)
            _to_the_end(unpacker, stream)
        except (tarfile.TarError, EOFError, zlib.error, gzip.BadGzipFile) as e:
            raise ArchiveError(
                f"{name} is damaged or not an archive ({e}); it was removed, run again to download it again"
            ) from None


def _members(tar: tarfile.TarFile, counted: _Counted) -> Iterator[tarfile.TarInfo]:
    while True:
        counted.header_left = MAX_HEADER_BYTES
        member = tar.next()
        tar.members.clear()  # pyright: ignore[reportAttributeAccessIssue]  # kept for random access, which is impossible on a stream
        if member is None:
            return
        counted.header_left = None
        yield member


def _take(unpacker: Unpacker, tar: tarfile.TarFile, member: tarfile.TarInfo) -> None:
    name = unpacker.archive.name
    if member.issym() or member.islnk():
        raise ArchiveError(f"{name} holds {shown(member.name)}, a link to {shown(member.linkname)}; it is not unpacked")
    if not (member.isreg() or member.isdir()) or member.issparse():
        raise ArchiveError(f"{name} holds {shown(member.name)}, a device, pipe or sparse file; it is not unpacked")
    path = unpacker.place(member.name, is_folder=member.isdir())
    if not member.isreg():
        return
    before = unpacker.bytes // _SPACE_EVERY_BYTES
    unpacker.count(member.size, member.name)  # wanted or not: it has to be read
    source = tar.extractfile(member)
    if source is None:
        raise ArchiveError(f"{name}: {shown(member.name)} has no content; the archive is damaged")
    if path is None:
        while source.read(1 << 20):
            pass
        return
    if unpacker.files == 0 or unpacker.bytes // _SPACE_EVERY_BYTES != before:
        require_space(unpacker.folder, max(member.size, _SPACE_EVERY_BYTES // 10), f"unpacking {name}")
    unpacker.write(path, source, member.size)


def _to_the_end(unpacker: Unpacker, stream: Readable) -> None:
    """Read what follows the last member, so that gzip compares its checksum; a few zero blocks at most."""
    left = MAX_HEADER_BYTES
    while block := stream.read(1 << 16):
        left -= len(block)
        if left < 0:
            raise ArchiveError(
                f"{unpacker.archive.name} continues after its end; it is damaged, or a decompression bomb"
            )
