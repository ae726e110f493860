"""Options of a command: names of a registry, and ``name=value`` texts."""

from collections.abc import Callable, Iterable
from dataclasses import field
from typing import Any

from ..checks import shown
from ..errors import ArgumentError, SequenceError
from ..files import parse_json


def named(default: Any, names: Callable[[], Iterable[str]]) -> Any:
    """A field of options that is one of the names of a registry, or several; the help lists them.

    Args:
        default: Its default, or a function that returns it.
        names: Returns what the registry has; it may add a few words in brackets to a name.
    """
    metadata = {"names": names}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def named_values(texts: Iterable[str]) -> dict[str, Any]:
    """``name=value`` texts as a dictionary of numbers, True or False, and words; a dash in a name
    is an underscore.

    Raises:
        ValueError: a text without "=".
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ArgumentError(f"expected an option as name=value, got {shown(text)}")
        values[name.strip().replace("-", "_")] = parse_value(value.strip())
    return values


def parse_value(text: str) -> Any:
    """A number, True or False, or the text itself if it is neither."""
    try:
        word = text.lower() if text.lower() in ("true", "false") else text
        return parse_json(word, text, "a value")
    except SequenceError:
        return text
