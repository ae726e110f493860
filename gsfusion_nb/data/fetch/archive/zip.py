"""Unpacking a zip: all names and sizes are checked before anything is written."""

import errno
import stat
import zipfile

from ....errors import shown
from ..disk import require_space
from ..errors import ArchiveError, NoSpaceError
from .unpacker import Unpacker


def unpack_zip(unpacker: Unpacker) -> None:
    """Unpack a zip. Raises ``ArchiveError``, ``NoSpaceError``."""
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
    except (ArchiveError, NoSpaceError):
        raise
    except Exception as e:  # zipfile raises what follows from the damaged bytes
        if isinstance(e, OSError) and e.errno != errno.EINVAL:
            raise
        raise ArchiveError(f"{name} is damaged ({e}); it was removed, run again to download it again") from None


def _zip_place(unpacker: Unpacker, info: zipfile.ZipInfo) -> str | None:
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "a link" if stat.S_ISLNK(kind) else "not a regular file"
        raise ArchiveError(f"{unpacker.archive.name} holds {shown(info.filename)}, {what}; nothing was unpacked")
    if info.flag_bits & 1:
        raise ArchiveError(f"{unpacker.archive.name} is encrypted; expected an archive without a password")
    return unpacker.place(info.filename, is_folder=info.is_dir())
