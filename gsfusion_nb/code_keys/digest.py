"""The hash under construction: what was put in, where it was, and which own modules and libraries
were met on the way."""

import hashlib
import types
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

from ..errors import ForeseenError

ATOMS = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), type(NotImplemented))
"""Kinds of values that their text says all of."""


class UnhashableError(ForeseenError, ValueError):
    """A value that cannot be hashed; the message says which and why."""


class Digest(ABC):
    """Takes values one after the other. Which kind of value is hashed how, ``add`` says.

    Args:
        strict: Raise ``UnhashableError`` for a value that cannot be hashed. Otherwise its type
            stands for it.
    """

    def __init__(self, strict: bool = True):
        self.modules: dict[int, types.ModuleType] = {}
        """Own modules that were met, by identity."""
        self.libraries: set[str] = set()
        """Names of the modules of libraries that were met."""
        self.caches: list[Any] = []
        """Functions with ``functools.cache`` or ``lru_cache``, such as one that reads a network."""
        self.walks_sets = False
        """A set was met, or own code that makes one."""
        self.strict = strict
        self.words: set[str] = set()
        """All names in own code, and all texts that could be one."""
        self.names_at: dict[int, set[str]] = {}
        """Identity of a module -> the names that were looked up there."""
        self._hash = hashlib.blake2b(digest_size=16)
        self._numbers: dict[int, tuple[int, Any]] = {}
        """Identity of an object -> its number, and the object, so that its identity is not given
        to another."""
        self._place: list[str] = []

    @abstractmethod
    def add(self, value: Any, place: str = "") -> None:
        """Add a value; ``place`` says where it is, for the message if it cannot be hashed."""

    def hexdigest(self) -> str:
        """The hash of all values so far."""
        return self._hash.hexdigest()

    def text(self, text: str) -> None:
        """Add a text by itself."""
        self._hash.update(text.encode(errors="surrogatepass") + b"\0")

    def data(self, data: bytes) -> None:
        """Add bytes by themselves."""
        self._hash.update(data)

    def add_all(self, values: Iterable[Any]) -> None:
        """Values in their order."""
        count = 0
        for value in values:
            self.add(value)
            count += 1
        self.text(f"{count} items")

    def add_mapping(self, x: Mapping[Any, Any]) -> None:
        """Values by keys of any kind, in their order."""
        for key, value in list(x.items()):
            self.add(key)
            self.add(value, f"[{key!r}]" if type(key) in ATOMS else "")
        self.text(f"{len(x)} items")

    def add_attributes(self, x: Mapping[str, Any], exclude: Iterable[str] = ()) -> None:
        """Values by name, whose order says nothing."""
        for name in sorted(map(str, x.keys() - set(exclude))):
            self.text(name)
            self.add(x[name], f".{name}")

    def is_new(self, x: Any) -> bool:
        """Whether an object was not met before; one that was is hashed by its number, so that
        circles end."""
        if id(x) in self._numbers:
            self.text(f"object {self._numbers[id(x)][0]}")
            return False
        self._numbers[id(x)] = len(self._numbers), x
        return True

    def merge(self, part: "Digest") -> None:
        """Take over what another digest met."""
        self.modules |= part.modules
        self.libraries |= part.libraries
        self.caches += part.caches
        self.words |= part.words

    def enter(self, place: str) -> None:
        """What is added from now on is at ``place`` of what is added now."""
        self._place.append(place)

    def leave(self) -> None:
        """The end of the place that was entered last."""
        self._place.pop()

    def where(self) -> str:
        """The place of what is added, in words."""
        steps = (place if place[0] in ".[" else f" {place}" for place in self._place)
        return "".join(steps).strip() or "a value"

    def give_up(self, x: Any, why: str) -> None:
        """A value that cannot be hashed.

        Raises:
            UnhashableError: the digest is strict.
        """
        if self.strict:
            raise UnhashableError(
                f"{self.where()} is a {type(x).__name__}, which cannot be hashed ({why})"
            )
        self.text("unhashable")
