"""Where the members of an archive may go: below one folder, each to a place of its own."""

import re
import unicodedata
from collections.abc import Callable

from ..errors import ArchiveError

Choose = Callable[[str], str | None]
"""A member's path in the archive -> its path in the data set's folder, or None to leave it out."""

_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f:*?"<>|]')
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def everything(name: str) -> str | None:
    """Chooses every member, where it is."""
    return name


def plain_path(name: str, archive: str) -> str:
    """``name`` as a relative path with forward slashes; empty for the archive's own root.

    Raises:
        ArchiveError: absolute, with a drive, or leading out by "..".
    """
    path = name.replace("\\", "/")
    if path.startswith("/") or re.match(r"[A-Za-z]:", path):
        raise ArchiveError(f"{archive} holds the absolute path {name!r}; nothing of it is unpacked")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise ArchiveError(f"{archive} holds {name!r}, which leads out of its folder; nothing of it is unpacked")
    return "/".join(parts)


def check_portable(path: str, archive: str) -> None:
    """Raise ``ArchiveError`` for a path with a part that some system does not take, or takes for something else."""
    for part in path.split("/"):
        if _FORBIDDEN.search(part) or _DEVICE.fullmatch(part) or part[-1] in ". " or len(part.encode()) > 255:
            raise ArchiveError(f"{archive} holds {path!r}, a name that not every system takes; nothing is unpacked")


class TakenPaths:
    """The paths taken so far. Two that are one on some system (case, accents) may not both be."""

    def __init__(self, archive: str):
        self._archive = archive
        self._files: set[str] = set()
        self._names: dict[str, str] = {}

    def take_folder(self, path: str) -> None:
        """Note a folder and those around it; the same one may come often."""
        parts = path.split("/")
        for n in range(1, len(parts) + 1):
            part = "/".join(parts[:n])
            key = _folded(part)
            if key in self._files:
                raise ArchiveError(f"{self._archive} holds {part!r} both as a file and as a folder")
            if self._names.setdefault(key, part) != part:
                raise ArchiveError(f"{self._archive} holds {part!r} and {self._names[key]!r}, one name on some systems")

    def take_file(self, path: str) -> None:
        """Note a file. Raises ``ArchiveError`` if its place is taken."""
        folder, _, _ = path.rpartition("/")
        if folder:
            self.take_folder(folder)
        key = _folded(path)
        if key in self._names:
            first = self._names[key]
            again = "twice" if first == path else f"and {first!r}, one name on some systems"
            raise ArchiveError(f"{self._archive} holds {path!r} {again}; expected one file per place")
        self._names[key] = path
        self._files.add(key)


def _folded(path: str) -> str:
    return unicodedata.normalize("NFC", path).casefold()
