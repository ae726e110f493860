"""Unpacking an archive that is not trusted: plain files only, below one folder, within limits on number and size.

If anything in an archive is refused, all of it is: a zip before anything is written; of a tar, which can only be read
from front to back, the caller removes what was written (``work_folder.unfinished_folder`` does).
"""

import zipfile
from pathlib import Path

from ..errors import ArchiveError
from .member_names import Choose, everything
from .tar import unpack_tar
from .unpacker import Limits, Unpacker
from .zip import unpack_zip


def unpack(archive: Path, folder: Path, *, choose: Choose = everything, limits: Limits) -> int:
    """Unpack a zip, tar or gzipped tar into ``folder``, which should be new; the number of files written.

    Raises:
        ArchiveError: no archive, a damaged one, or one that holds links, devices, paths that lead elsewhere, two files
        for one place, or more than ``limits``. NoSpaceError: the disk is too full.
    """
    unpacker = Unpacker(archive, folder, choose, limits)
    folder.mkdir(parents=True, exist_ok=True)
    if zipfile.is_zipfile(archive):
        unpack_zip(unpacker)
    else:
        unpack_tar(unpacker)
    if not unpacker.files:
        raise ArchiveError(f"{archive.name} holds none of the files that were expected in it")
    return unpacker.files
