"""Errors of a recording and of its frames, and what a command says of an error that nobody foresaw.

Readers and mappers raise them; the loop of a run decides what follows."""

import datetime
import linecache
import os
import tempfile
import traceback
from pathlib import Path
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


def is_foreseen(error: BaseException) -> bool:
    """The text of ``error`` is a sentence for people: an error of this package's own, what a ``raise`` of this package
    wrote, or an error about a file.

    A ``ValueError`` of a text that is no number, somewhere deep inside, is none.
    """
    package = __name__.partition(".")[0]
    if isinstance(error, OSError) or type(error).__module__.startswith(package):
        return True
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not isinstance(error, (ValueError, TypeError, KeyError, MemoryError)):
        return False
    ours = str(last.tb_frame.f_globals.get("__name__", "")).startswith(package)
    line = linecache.getline(last.tb_frame.f_code.co_filename, last.tb_lineno).strip()
    return ours and (not line or line.startswith("raise"))


def unforeseen(error: BaseException, command: str, arguments: list[str]) -> str:
    """One sentence on ``error`` that names the file concerned and the log file with the traceback.

    The log is written to the folder of the run if the arguments name one that exists (``--out``, ``--resume``), else to
    the system's folder for temporary files.

    Args:
        error: What was raised.
        command: The command as it was typed, without its arguments, such as ``gsfusion-nb map``.
        arguments: The arguments.
    """
    from .work import memory_is_full

    log = _write_log(error, command, arguments)
    lines = str(error).strip().splitlines()
    if memory_is_full(error):
        said = f" ({lines[0][:160]})" if lines else ""
        return (
            f"the memory is full{said}, {_concerned(error, arguments)}; use smaller or fewer images, close other "
            "programs, or raise the limit of memory (ulimit -v)"
        )
    reason = f"{type(error).__name__}{f' ({lines[0][:160]})' if lines else ''}"
    where = f"the traceback is in {log}" if log else "the traceback could not be written to a file"
    return f"ended by an unexpected error, {reason}, {_concerned(error, arguments)}; {where}"


def _concerned(error: BaseException, arguments: list[str]) -> str:
    """The file that the error names, or else what the command was given."""
    name = getattr(error, "filename", None)
    if name:
        return f"at {name}"
    places = [a.partition("=")[2] if a.startswith("-") else a for a in arguments]
    places = [place for place in places if place and Path(place).exists()]
    return f"while it worked on {' and '.join(places[:3])}" if places else "at no file in particular"


def _write_log(error: BaseException, command: str, arguments: list[str]) -> Path | None:
    name = f"{command.replace(' ', '-')}-{datetime.datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}.log"
    text = "".join([f"{command} {' '.join(arguments)}\n\n", *traceback.format_exception(error)])
    for folder in (_run_folder(arguments), Path(tempfile.gettempdir())):
        try:
            if folder is not None:
                (folder / name).write_text(text, encoding="utf-8", errors="backslashreplace")
                return folder / name
        except OSError:
            continue
    return None


def _run_folder(arguments: list[str]) -> Path | None:
    """The value of ``--out`` or ``--resume``, if it is a folder."""
    for option in ("--out", "--resume"):
        for i, argument in enumerate(arguments):
            name, equals, value = argument.partition("=")
            value = value if equals else "".join(arguments[i + 1 : i + 2])
            if name == option and value and Path(value).is_dir():
                return Path(value)
    return None
