"""Errors of a recording and of its frames: readers and mappers raise them, the loop of a run decides what follows."""

from typing import Any

MAX_SENTENCE = 1000
"""Characters of a message; a path has at most a few hundred."""


def shown(value: Any, at_most: int = 120) -> str:
    """A value that somebody else wrote, as one line short enough for a sentence: all messages quote with this.

    Text, and what holds more than ``at_most`` items, is cut before it is formatted.
    """
    if isinstance(value, str | bytes | list | tuple):
        value = value[: at_most + 1]
    text = repr(value)
    return text if len(text) <= at_most else f"{text[: at_most - 3]}..."


def as_sentence(text: str) -> str:
    """A message as one line; of a very long one, which holds a long name of somebody else's, beginning and end."""
    text = " ".join(text.splitlines())
    half = MAX_SENTENCE // 2 - 5
    return text if len(text) <= MAX_SENTENCE else f"{text[:half]} [...] {text[-half:]}"


class SequenceError(ValueError):
    """A file or folder that was given, or what was asked of it, makes no sense; one sentence that names the file."""

    def __str__(self) -> str:
        return as_sentence(super().__str__())


class SequenceNotFoundError(SequenceError, FileNotFoundError):
    """A folder or file that the sequence needs is not there."""


class BadFrameError(SequenceError):
    """One frame cannot be used (damaged image, no depth, invalid pose, tracking lost); the next frame may be fine."""
