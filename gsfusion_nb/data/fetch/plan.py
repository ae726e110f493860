"""Description of a download, shown before it starts."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .archive.member_names import Choose, everything
from .disk import size_text
from .errors import DeclinedError
from .sequence_on_disk import SequenceOnDisk

ASSUMED_BYTES_PER_S = 10e6
"""100 Mbit/s, for the time estimate; university servers are often slower."""

_UNPACK_BYTES_PER_S = 60e6


@dataclass(frozen=True, kw_only=True)
class Item:
    """One file to download."""

    base: str
    """Address of the folder on the host; a mirror replaces it."""
    path: str
    """Address below ``base``."""
    stated_bytes: int
    """Published or estimated size; the server is asked before the download starts."""
    checksum: str = ""
    """Published digest, ``algorithm:hexadecimal``."""
    choose: Choose = everything
    """Which members of the archive are unpacked, and to which paths."""
    save_as: str = ""
    """For a file that is not an archive: its path in the data set's folder."""

    def url(self, mirror: str = "") -> str:
        """Address at the host, or at a mirror with the same paths."""
        return f"{(mirror or self.base).rstrip('/')}/{self.path}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A data set: its files, how they are processed, and its licence."""

    folder: str
    """Folder of the data set, inside the folder of all data sets."""
    title: str
    licence: str
    """The terms in a sentence."""
    cite: str
    items: list[Item]
    unpacked_bytes: int
    """Approximate size on disk in the end."""
    sequences: Callable[[Path], list[SequenceOnDisk]]
    """The sequences in the finished folder, and how to map them."""
    convert: Callable[[Path], None] = lambda folder: None
    """How the unpacked files are processed."""
    note: str = ""
    """A sentence that helps the user to decide."""
    most_growth: float = 3.0
    """A file, and what it unpacks to, may be this many times the stated size before it is refused."""


def describe(plan: Plan, out: Path, sizes: list[int | None], mirror: str = "") -> str:
    """Contents, size, licence and time of a plan. ``sizes``: as reported by the servers, None where unknown."""
    known = [size if size is not None else item.stated_bytes for size, item in zip(sizes, plan.items, strict=True)]
    seconds = sum(known) / ASSUMED_BYTES_PER_S + plan.unpacked_bytes / _UNPACK_BYTES_PER_S
    lines = [plan.title]
    for item, size, best in zip(plan.items, sizes, known, strict=True):
        told = "" if size is not None else ", estimated"
        check = (
            f"compared with its published {item.checksum.partition(':')[0]}" if item.checksum else "no checksum public"
        )
        lines.append(f"  from     {item.url(mirror)} ({size_text(best)}{told}; {check})")
    lines += [
        f"  to       {out / plan.folder} (about {size_text(plan.unpacked_bytes)}; {size_text(sum(known))} to download)",
        f"  time     about {duration_text(seconds)} at 100 Mbit/s",
        f"  licence  {plan.licence}",
        f"  cite     {plan.cite}",
    ]
    return "\n".join([*lines, f"  note     {plan.note}"] if plan.note else lines)


def agree(*, yes: bool, ask: Callable[[str], str] | None) -> None:
    """Return if the user agreed. ``ask`` is None where there is no user to ask.

    Raises:
        DeclinedError: the answer was no, or there is no user to ask and ``yes`` was not given.
    """
    if yes:
        return
    if ask is None:
        raise DeclinedError(
            "cannot ask whether you agree to size and licence, because this is not a terminal; run again with --yes"
        )
    try:
        answer = ask("Go on under this licence? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise DeclinedError("nothing was fetched")


def duration_text(seconds: float) -> str:
    """A duration as text."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
