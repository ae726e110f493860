"""Unpacking archives of data sets: only what is wanted, and nothing outside of the folder."""

import gzip
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from ..checks import shown
from ..errors import SequenceError
from ..files import open_regular

Choose = Callable[[str], str | None]
"""A member's path in the archive -> its path in the data set's folder, or None to leave it out."""


class FetchError(SequenceError):
    """A data set could not be fetched or prepared; the message names the address or file."""


class ArchiveError(FetchError):
    """An archive is damaged, or holds something that must not be unpacked."""


def unpack(
    archive: Path,
    folder: Path,
    *,
    choose: Choose = lambda name: name,
) -> int:
    """Unpack the chosen regular files of a zip, tar or gzipped tar into ``folder``; the number of
    files written.

    Raises:
        ArchiveError: not an archive, a damaged one, one with a path outside of the folder, or with
            none of the chosen files.
    """
    count = 0
    try:
        for name, source in _members(archive):
            path = choose(name)
            if path is None:
                continue
            if (
                PurePosixPath(path).is_absolute()
                or ".." in PurePosixPath(path).parts
                or "\\" in path
                or ":" in path
            ):
                raise ArchiveError(
                    f"{archive.name} holds {shown(name)}, which is outside of the target folder"
                )
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            with (folder / path).open("xb") as file:
                shutil.copyfileobj(source, file)
            count += 1
    except ArchiveError:
        raise
    except (
        ValueError,
        NotImplementedError,
        RuntimeError,
        zipfile.BadZipFile,
        tarfile.TarError,
        gzip.BadGzipFile,
        zlib.error,
        EOFError,
    ) as e:
        raise ArchiveError(
            f"{archive.name} is damaged or not an archive ({e}); run again to download it again"
        ) from None
    if not count:
        raise ArchiveError(f"{archive.name} holds none of the expected files")
    return count


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Path and content of each regular file; links and devices are left out."""
    with open_regular(archive, "an archive") as stream:
        if zipfile.is_zipfile(stream):
            with zipfile.ZipFile(stream) as zip_file:
                for info in zip_file.infolist():
                    if not info.is_dir() and stat.S_IFMT(info.external_attr >> 16) in (
                        0,
                        stat.S_IFREG,
                    ):
                        try:
                            source = zip_file.open(info)
                        except OSError as e:  # it points outside of the file
                            raise zipfile.BadZipFile(str(e)) from None
                        with source:
                            yield info.filename, source
            return
        stream.seek(0)
        with tarfile.open(fileobj=stream, mode="r|*") as tar:
            for member in tar:
                source = tar.extractfile(member) if member.isreg() else None
                if source is not None:
                    yield member.name, source
