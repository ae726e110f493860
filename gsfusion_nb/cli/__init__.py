"""The command ``gsfusion-nb``: how it ends, whatever happens in a command (``commands``)."""

import contextlib
import errno
import io
import logging
import os
import sys

from ..errors import FORESEEN, crash_sentence
from ..interrupts import end_process
from .commands import COMMANDS, PROGRAM, print_help

_REFUSED = {
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
}
"""Errors of a place that may not be read or written."""

NOBODY_READS = 141
"""Exit status, as of a program that the signal SIGPIPE ended."""


def program() -> int:
    """What is installed as ``gsfusion-nb``: ``main`` with the arguments of the process, which ends
    then, also while a compiler still works."""
    if sys.argv[1:2] != ["course"]:  # Jupyter's kernels import what is beside a notebook
        # a recording's folder in which the command is started may hold a pickle.py: the processes
        # that the command starts import from it as little as the command itself
        os.environ.setdefault("PYTHONSAFEPATH", "1")
    status = main()
    end_process(status)
    return status


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Exit status: 0 done, 1 an error (its message is printed), 3 a map that
    ends before its recording (``print_result``), 130 interrupted, 141 nobody reads the output any
    more."""
    for stream in (sys.stdout, sys.stderr):
        # a path in another script ends no command on a terminal of cp1252
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        status = _main(sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's end says nothing, either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    return status


def _main(arguments: list[str]) -> int:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        print_help()
        return 0
    if name not in COMMANDS:
        print(f"no command {name!r}", file=sys.stderr)
        with contextlib.redirect_stdout(sys.stderr):
            print_help()
        return 2
    try:
        return COMMANDS[name].run(name, rest)
    except BrokenPipeError:
        raise
    except Exception as e:
        _print_end(name, _sentence(e, name, rest), e)
        return 1
    except KeyboardInterrupt as e:
        _print_end(name, "interrupted", e)
        return 130


def _sentence(error: Exception, name: str, arguments: list[str]) -> str:
    """What went wrong; of an error that nobody foresaw, where its traceback is."""
    if isinstance(error, OSError) and error.errno in _REFUSED and error.filename:
        place = os.path.abspath(os.fsdecode(error.filename))
        return (
            f"{_REFUSED[error.errno]}: {place}; expected to read it, or to write there: --out "
            "names another folder"
        )
    if not isinstance(error, FORESEEN):
        return crash_sentence(error, f"{PROGRAM} {name}", arguments)
    return str(error)


def _print_end(name: str, text: str, error: BaseException) -> None:
    print(f"{PROGRAM} {name}: {text}", file=sys.stderr)
    for note in getattr(error, "__notes__", ()):
        print(note, file=sys.stderr)
