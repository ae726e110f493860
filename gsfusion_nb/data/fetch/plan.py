"""What will be fetched, described before it starts."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .archive.member_names import Choose, everything
from .disk import size_text
from .errors import DeclinedError
from .sequence_on_disk import SequenceOnDisk

ASSUMED_BYTES_PER_S = 10e6
"""A line of 100 Mbit/s, for the estimate of time; the servers of universities often give less."""

_UNPACK_BYTES_PER_S = 60e6


@dataclass(frozen=True, kw_only=True)
class Item:
    """One file to download."""

    base: str
    """Address of the host's folder; a mirror takes its place."""
    path: str
    """Address below ``base``."""
    stated_bytes: int
    """Size as others tell it or as estimated; the server is asked before the start."""
    checksum: str = ""
    """Published digest, ``algorithm:hexadecimal``."""
    choose: Choose = everything
    """Which members of the archive go where."""
    save_as: str = ""
    """The file is no archive: its path in the data set's folder."""

    def url(self, mirror: str = "") -> str:
        """Address at the host, or at a mirror with the same paths."""
        return f"{(mirror or self.base).rstrip('/')}/{self.path}"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A data set: the files it is made of, what becomes of them, and on which terms."""

    folder: str
    """Folder to make, below the folder of all data sets."""
    title: str
    licence: str
    """The terms in a sentence."""
    cite: str
    items: list[Item]
    unpacked_bytes: int
    """About what it fills on disk in the end."""
    sequences: Callable[[Path], list[SequenceOnDisk]]
    """The sequences in the finished folder, and how to map them."""
    convert: Callable[[Path], None] = lambda folder: None
    """What is done to the unpacked files."""
    note: str = ""
    """A sentence that helps the user to decide."""
    most_growth: float = 3.0
    """A file, and what it unpacks to, may be this many times the stated size before it is refused."""


def describe(plan: Plan, out: Path, sizes: list[int | None], mirror: str = "") -> str:
    """Contents, size, terms and time of a plan. ``sizes``: as the servers tell them, None where they do not."""
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
        raise DeclinedError("there is no terminal to ask whether you agree to size and licence; run again with --yes")
    try:
        answer = ask("Go on under this licence? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise DeclinedError("nothing was fetched")


def duration_text(seconds: float) -> str:
    """Seconds for people."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
