"""Unpacking an archive that is not trusted: plain files only, below one folder, within limits on number and size.

What is refused is refused whole: a zip before anything is written; of a tar, which can only be read from front to back,
the caller throws away what was written (``work_folder.unfinished_folder`` does).
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from .disk import full_disk, require_space, size_text
from .errors import ArchiveError
from .member_names import Choose, Places, check_portable, everything, plain_path

BLOCK_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an archive may become."""

    max_bytes: int
    """Of all files together."""
    max_ratio: float = 100.0
    """Bytes of all files over bytes of the archive; images hardly shrink, text shrinks by ten."""
    max_files: int = 200_000
    """Members, folders included."""


@runtime_checkable
class Readable(Protocol):
    """Anything that gives its bytes block by block."""

    def read(self, size: int = -1, /) -> bytes:
        """Up to ``size`` bytes; empty at the end."""
        ...


class Unpacker:
    """Puts the members of one archive into a folder and keeps count of them."""

    def __init__(self, archive: Path, folder: Path, choose: Choose, limits: Limits):
        self.archive, self.folder, self.choose, self.limits = archive, folder, choose, limits
        ratio_bytes = int(limits.max_ratio * archive.stat().st_size)
        self.max_bytes = min(limits.max_bytes, ratio_bytes)
        self.members = self.files = self.bytes = 0
        self._places = Places(archive.name)

    def place(self, name: str, *, is_folder: bool) -> str | None:
        """Where a member goes, None if it is not wanted. Wanted or not, it must not lead out."""
        self.members += 1
        if self.members > self.limits.max_files:
            raise ArchiveError(
                f"{self.archive.name} holds more than {self.limits.max_files} members; it is no data set"
            )
        path = plain_path(name, self.archive.name)
        wanted = None if is_folder or not path else self.choose(path)
        if wanted is None:
            return None
        target = plain_path(wanted, self.archive.name)
        check_portable(target, self.archive.name)
        self._places.take_file(target)
        return target

    def count(self, size: int, path: str) -> None:
        """Add bytes, real or promised, to those there are. Raises ``ArchiveError`` beyond the limit."""
        self.bytes += size
        if size < 0 or self.bytes > self.max_bytes:
            raise ArchiveError(
                f"{self.archive.name} becomes more than {size_text(self.max_bytes)} at {path!r}, too much for its "
                f"{size_text(self.archive.stat().st_size)}; it is no data set, or a bomb"
            )

    def write(self, path: str, source: Readable, size: int) -> None:
        """Copy a member of ``size`` bytes, no more and no less."""
        target = self.folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        done = 0
        try:
            with target.open("xb") as file:
                while block := source.read(BLOCK_BYTES):
                    done += len(block)
                    if done > size:
                        break
                    file.write(block)
        except OSError as e:
            raise full_disk(e, target) or e from None
        if done != size:
            raise ArchiveError(f"{self.archive.name}: {path!r} says it has {size} bytes, but it has not; damaged")
        self.files += 1


def unpack(archive: Path, folder: Path, *, choose: Choose = everything, limits: Limits) -> int:
    """Unpack a zip, tar or gzipped tar into ``folder``, which should be new; the number of files written.

    Raises:
        ArchiveError: no archive, a damaged one, or one that holds links, devices, paths that lead elsewhere, two files
        for one place, or more than ``limits``. NoSpaceError: the disk is too full.
    """
    from .unpack_tar import unpack_tar

    unpacker = Unpacker(archive, folder, choose, limits)
    folder.mkdir(parents=True, exist_ok=True)
    if zipfile.is_zipfile(archive):
        _unpack_zip(unpacker)
    else:
        unpack_tar(unpacker)
    if not unpacker.files:
        raise ArchiveError(f"{archive.name} holds none of the files that were expected in it")
    return unpacker.files


def _unpack_zip(unpacker: Unpacker) -> None:
    name = unpacker.archive.name
    try:
        with zipfile.ZipFile(unpacker.archive) as zipped:
            wanted = [(path, info) for info in zipped.infolist() if (path := _zip_place(unpacker, info)) is not None]
            for path, info in wanted:
                unpacker.count(info.file_size, path)
            require_space(unpacker.folder, unpacker.bytes, f"unpacking {name}")
            for path, info in wanted:
                with zipped.open(info) as source:
                    unpacker.write(path, source, info.file_size)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, *_decompression_errors()) as e:
        raise ArchiveError(f"{name} is damaged ({e}); it is no longer kept, run again to fetch it anew") from None


def _zip_place(unpacker: Unpacker, info: zipfile.ZipInfo) -> str | None:
    import stat

    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "a link" if stat.S_ISLNK(kind) else "no plain file"
        raise ArchiveError(f"{unpacker.archive.name} holds {info.filename!r}, {what}; nothing of it is unpacked")
    if info.flag_bits & 1:
        raise ArchiveError(f"{unpacker.archive.name} is encrypted; expected an open archive")
    return unpacker.place(info.filename, is_folder=info.is_dir())


def _decompression_errors() -> tuple[Any, ...]:
    import lzma
    import zlib

    return zlib.error, lzma.LZMAError
