"""What installed packages add: systems, seeding rules and readers of recordings, each by an entry
point in the metadata of its package."""

import functools
import importlib.metadata
import logging
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from .errors import ArgumentError

log = logging.getLogger(__name__)

Kind = Literal["systems", "rules", "readers"]
"""What can be added; the group of its entry points is ``gsfusion_nb.<kind>``."""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Something that an installed package adds."""

    kind: Kind
    name: str
    """By which users ask for it: the name of the entry point."""
    package: str
    """Name and version of the package, such as "egg-fusion 0.1.0"."""
    entry: importlib.metadata.EntryPoint

    def load(self) -> Any:
        """The object, after its module was imported.

        Raises:
            ValueError: the module raises an error, or has no such object.
        """
        try:
            return self.entry.load()
        except Exception as e:  # the package of somebody else
            raise ArgumentError(
                f"{self.in_words} cannot be loaded: {type(e).__name__}: {e}"
            ) from None

    @property
    def in_words(self) -> str:
        """For messages: what it is, and where it comes from."""
        kind = {"systems": "system", "rules": "seeding rule", "readers": "reader"}[self.kind]
        return f"the {kind} {self.name!r} of the package {self.package} ({self.entry.value})"


def extensions(kind: Kind, built_in: Collection[str] = ()) -> dict[str, Extension]:
    """What installed packages add of one kind, by name; nothing of them is imported.

    A name that something built in has, or two packages, is left out, and a warning says so, once.

    Args:
        kind: What is asked for.
        built_in: Names that are taken.
    """
    offers: dict[str, list[Extension]] = {}
    for entry in importlib.metadata.entry_points(group=f"gsfusion_nb.{kind}"):
        dist = entry.dist
        package = "of unknown name" if dist is None else f"{dist.name} {dist.version}"
        extension = Extension(kind=kind, name=entry.name, package=package, entry=entry)
        same = offers.setdefault(entry.name, [])
        if all((other.package, other.entry.value) != (package, entry.value) for other in same):
            same.append(extension)
    for name, same in sorted(offers.items()):
        if name in built_in:
            warn_once(f"{same[0].in_words} is not used: gsfusion_nb itself has one of that name")
        elif len(same) > 1:
            packages = " and ".join(other.package for other in same)
            warn_once(f"{same[0].in_words} is not used: {packages} have that name; remove one")
    return {
        name: same[0]
        for name, same in sorted(offers.items())
        if name not in built_in and len(same) == 1
    }


@functools.cache
def warn_once(sentence: str) -> None:
    """Log a warning, once in a process."""
    log.warning(sentence)
