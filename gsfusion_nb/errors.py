"""The errors whose text is a sentence for people, and the log of all others.

The command line prints a ``ForeseenError`` as one line. Any other error is a mistake of the
program, and its traceback goes into a crash log.
"""

import datetime
import os
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MAX_SENTENCE = 1000
"""Characters of a message; a path has at most a few hundred."""


def as_sentence(text: str) -> str:
    """A message as one line; of a very long one, which holds a long name of somebody else's,
    beginning and end."""
    text = " ".join(text.splitlines())
    half = MAX_SENTENCE // 2 - 5
    return text if len(text) <= MAX_SENTENCE else f"{text[:half]} [...] {text[-half:]}"


class ForeseenError(Exception):
    """The base of this package's errors; the text is a sentence that says what was expected and
    what came instead."""


FORESEEN = (ForeseenError, OSError)
"""What the command line prints as one line: also what the system says about a file."""


class ArgumentError(ForeseenError, ValueError):
    """The value of an argument or a setting makes no sense."""


class KindError(ForeseenError, TypeError):
    """An argument or a setting is of the wrong kind."""


class UnknownNameError(ForeseenError, KeyError):
    """Nothing has this name; the text lists the known ones."""

    def __str__(self) -> str:
        return str(self.args[0])


class MemoryFullError(ForeseenError, MemoryError):
    """There is no memory for a part of the map."""


class SequenceError(ForeseenError, ValueError):
    """A file or folder that was given, or what was asked of it, makes no sense; one sentence that
    names the file."""

    def __str__(self) -> str:
        return as_sentence(super().__str__())


class SequenceNotFoundError(SequenceError, FileNotFoundError):
    """A folder or file that the sequence needs is not there."""


class BadFrameError(SequenceError):
    """One frame cannot be used (damaged image, no depth, invalid pose, tracking lost); the next
    frame may be fine."""


class DiskFullError(ForeseenError, OSError):
    """There is no room for a file; the message names it, and what leaves none: the disk, a quota or
    a limit."""

    def __str__(self) -> str:
        return str(self.args[1])


@contextmanager
def refusing(prefix: str = "", error: type[SequenceError] = SequenceError) -> Iterator[None]:
    """A ``ValueError`` that a check raises in the block becomes an ``error`` with the text
    ``prefix`` its message."""
    try:
        yield
    except ValueError as e:
        raise error(f"{prefix}{e}") from None


def reason_of(error: Exception) -> str:
    """The kind and the first sentence of an error, short enough to be a part of another
    sentence."""
    lines = str(error).strip().splitlines()
    text = lines[0].split(". ")[0][:160] if lines else ""
    return (
        text
        if isinstance(error, OSError | ValueError) and text
        else f"{type(error).__name__} {text}".strip()
    )


def memory_is_full(error: BaseException) -> bool:
    """Whether an error says, in the words of Python, torch, OpenCV or C++, that there is no more
    memory."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    text = str(error)
    return any(
        words in text
        for words in (
            "can't allocate memory",
            "bad_alloc",
            "Insufficient memory",
            "Cannot allocate",
        )
    )


def crash_sentence(error: BaseException, command: str, arguments: list[str]) -> str:
    """One sentence on an error that is no ``FORESEEN`` one; it names the log with the traceback,
    in the system's folder for temporary files.

    Args:
        error: What was raised.
        command: The command as it was typed, without its arguments, such as ``gsfusion-nb map``.
        arguments: The arguments.
    """
    message = f" ({str(error).strip().splitlines()[0][:160]})" if str(error).strip() else ""
    if memory_is_full(error):
        return f"the memory is full{message}; use smaller or fewer images, or close other programs"
    reason = f"ended by an unexpected error, {type(error).__name__}{message}"
    name = f"{command.replace(' ', '-')}-{datetime.datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}.log"
    log = Path(tempfile.gettempdir(), name)
    text = "".join([f"{command} {' '.join(arguments)}\n\n", *traceback.format_exception(error)])
    try:
        log.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as e:
        return f"{reason}; the traceback could not be written to {log} ({e.strerror})"
    return f"{reason}; the traceback is in {log}"
