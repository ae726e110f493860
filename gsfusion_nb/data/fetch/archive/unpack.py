"""Unpacking an archive that is not trusted: regular files only, inside one folder, within limits on number and size.

If one member is refused, the whole archive is. A zip is refused before anything is written. A tar can only be read from
front to back, so the caller removes what was written (``work_folder.unfinished_folder`` does this).
"""

import zipfile
from pathlib import Path

from ....foreign import open_regular
from ..errors import ArchiveError
from .member_names import Choose, everything
from .tar import unpack_tar
from .unpacker import Limits, Unpacker
from .zip import unpack_zip


def unpack(archive: Path, folder: Path, *, choose: Choose = everything, limits: Limits) -> int:
    """Unpack a zip, tar or gzipped tar into ``folder``, which should be new; the number of files written.

    Raises:
        ArchiveError: not an archive, a damaged one, or one with links, devices, paths outside the folder, two files
            with one path, or more than ``limits``. NoSpaceError: the disk is too full.
    """
    open_regular(archive, "an archive").close()
    unpacker = Unpacker(archive, folder, choose, limits)
    folder.mkdir(parents=True, exist_ok=True)
    if zipfile.is_zipfile(archive):
        unpack_zip(unpacker)
    else:
        unpack_tar(unpacker)
    if not unpacker.files:
        raise ArchiveError(f"{archive.name} holds none of the expected files")
    return unpacker.files
