"""Checks of the paths in an archive: all inside one folder, no two to the same place."""

import re
import unicodedata
from collections.abc import Callable

from ....errors import shown
from ..errors import ArchiveError

Choose = Callable[[str], str | None]
"""A member's path in the archive -> its path in the data set's folder, or None to leave it out."""

_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f:*?"<>|]')
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def everything(name: str) -> str | None:
    """Choose every member, at its own path."""
    return name


def plain_path(name: str, archive: str) -> str:
    """``name`` as a relative path with forward slashes; empty for the archive's own root.

    Raises:
        ArchiveError: absolute, with a drive letter, or outside the folder through "..".
    """
    path = name.replace("\\", "/")
    if path.startswith("/") or re.match(r"[A-Za-z]:", path):
        raise ArchiveError(f"{archive} holds the absolute path {shown(name)}; nothing was unpacked")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise ArchiveError(f"{archive} holds {shown(name)}, which is outside the target folder; nothing was unpacked")
    return "/".join(parts)


def check_portable(path: str, archive: str) -> None:
    """Raise ``ArchiveError`` for a path that is invalid, or means something else, on some operating system."""
    for part in path.split("/"):
        if _FORBIDDEN.search(part) or _DEVICE.fullmatch(part) or part[-1] in ". " or len(part.encode()) > 255:
            raise ArchiveError(
                f"{archive} holds {shown(path)}, a name that is invalid on some operating systems; nothing was unpacked"
            )


class TakenPaths:
    """The paths used so far. Two paths that some operating system does not distinguish (case, accents) are refused."""

    def __init__(self, archive: str):
        self._archive = archive
        self._files: set[str] = set()
        self._names: dict[str, str] = {}

    def take_folder(self, path: str) -> None:
        """Add a folder and its parents; a folder may be added repeatedly."""
        parts = path.split("/")
        for n in range(1, len(parts) + 1):
            part = "/".join(parts[:n])
            key = _folded(part)
            if key in self._files:
                raise ArchiveError(f"{self._archive} holds {shown(part)} both as a file and as a folder")
            if self._names.setdefault(key, part) != part:
                raise ArchiveError(
                    f"{self._archive} holds {shown(part)} and {shown(self._names[key])}, which are the same name "
                    "on some systems"
                )

    def take_file(self, path: str) -> None:
        """Add a file. Raises ``ArchiveError`` if its path is already used."""
        folder, _, _ = path.rpartition("/")
        if folder:
            self.take_folder(folder)
        key = _folded(path)
        if key in self._names:
            first = self._names[key]
            again = "twice" if first == path else f"and {shown(first)}, which are the same name on some systems"
            raise ArchiveError(f"{self._archive} holds {shown(path)} {again}; expected one file per place")
        self._names[key] = path
        self._files.add(key)


def _folded(path: str) -> str:
    return unicodedata.normalize("NFC", path).casefold()
