"""Writing the members of an archive that is not trusted into one folder, within limits on number and size."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from ....errors import shown
from ..disk import full_disk, size_text
from ..errors import ArchiveError
from .member_names import Choose, TakenPaths, check_portable, plain_path

BLOCK_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How large an unpacked archive may be."""

    max_bytes: int
    """Bytes of all files together."""
    max_ratio: float = 100.0
    """Bytes of all files divided by bytes of the archive: about 1 for images, 10 for text."""
    max_files: int = 200_000
    """Number of members, including folders."""


@runtime_checkable
class Readable(Protocol):
    """Anything that can be read block by block."""

    def read(self, size: int = -1, /) -> bytes:
        """Up to ``size`` bytes; empty at the end."""
        ...


class Unpacker:
    """Writes the members of one archive into a folder and counts them."""

    def __init__(self, archive: Path, folder: Path, choose: Choose, limits: Limits):
        self.archive, self.folder, self.choose, self.limits = archive, folder, choose, limits
        ratio_bytes = int(limits.max_ratio * archive.stat().st_size)
        self.max_bytes = min(limits.max_bytes, ratio_bytes)
        self.members = self.files = self.bytes = 0
        self._taken = TakenPaths(archive.name)

    def place(self, name: str, *, is_folder: bool) -> str | None:
        """Target path of a member, None if it is not chosen. Its own path must be inside the folder in both cases."""
        self.members += 1
        if self.members > self.limits.max_files:
            raise ArchiveError(
                f"{self.archive.name} holds more than {self.limits.max_files} members, too many for a data set"
            )
        path = plain_path(name, self.archive.name)
        wanted = None if is_folder or not path else self.choose(path)
        if wanted is None:
            return None
        target = plain_path(wanted, self.archive.name)
        check_portable(target, self.archive.name)
        self._taken.take_file(target)
        return target

    def count(self, size: int, path: str) -> None:
        """Add bytes, written or announced, to the total. Raises ``ArchiveError`` beyond the limit."""
        self.bytes += size
        if size < 0 or self.bytes > self.max_bytes:
            raise ArchiveError(
                f"{self.archive.name} unpacks to more than {size_text(self.max_bytes)} at {shown(path)}, too much for "
                f"its {size_text(self.archive.stat().st_size)}; it may be a decompression bomb"
            )

    def write(self, path: str, source: Readable, size: int) -> None:
        """Copy a member that must have exactly ``size`` bytes."""
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
            raise ArchiveError(
                f"{self.archive.name}: {shown(path)} should have {size} bytes but has another size; the archive is "
                "damaged"
            )
        self.files += 1
