"""What a seeding rule reads besides its context: files that it does not declare, the environment,
other programs.

Python tells what it opens and starts (audit events, PEP 578). What compiled code opens by itself is
not told.
"""

import _thread
import contextlib
import functools
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ..errors import ForeseenError
from .rule_watch import RuleWatch

_ASKS = ("stat", "lstat", "access", "readlink")
"""Functions of ``os`` that say something of a file without opening it, of which Python does not
tell."""
_COMPILED_READERS = (
    *(("cv2", name) for name in ("imread", "imreadmulti", "VideoCapture", "FileStorage")),
    *(("torch", "from_file"), ("torch.jit", "load")),
)
"""Functions whose compiled code opens the file that their first argument names."""


class UndeclaredError(ForeseenError, ValueError):
    """A rule reads something that decides its seeds and that no option names."""


_local = threading.local()
_patching = threading.RLock()


def _watch() -> RuleWatch | None:
    return getattr(_local, "watch", None)


@functools.cache
def _listen() -> None:
    # A lambda, which no tool that checks types wraps: a wrapper raises events itself, and they
    # would never end.
    sys.addaudithook(lambda event, arguments: _tell(event, arguments))


def _tell(event: str, arguments: tuple[Any, ...]) -> None:
    watch: RuleWatch | None = getattr(_local, "watch", None)
    if watch is None:
        return
    _local.watch = None  # what is opened while this is looked at is not the rule's
    try:
        watch.note(event, arguments)
    finally:
        _local.watch = watch


@contextlib.contextmanager
def _report_calls(watch: RuleWatch) -> Iterator[None]:
    """Tell ``watch`` of what Python does not tell of: the variables that are read, files that are
    asked for, and those that compiled code opens, in this thread."""
    kind: Any = type(os.environ)

    def reporting(function: Any, tell: Callable[[Any], None]) -> Any:
        @functools.wraps(function)
        def reporter(*arguments: Any, **options: Any) -> Any:
            if _watch() is watch and arguments:
                tell(arguments[0])
            return function(*arguments, **options)

        return reporter

    def tell_of_thread(_: Any) -> None:
        watch.note_thread()

    def tell_of_variables(_: Any) -> None:
        watch.note_variables()

    def tell_of_variable(environ: Any, name: Any) -> Any:
        if _watch() is watch:
            watch.note_variable(os.fsdecode(name))
        return read(environ, name)

    with _patching:
        read = kind.__getitem__
        replacements: list[tuple[Any, str, Any]] = [(kind, "__getitem__", tell_of_variable)]
        replacements += [
            (kind, name, reporting(getattr(kind, name), tell_of_variables))
            for name in ("__iter__", "__len__")
        ]
        replacements += [
            (os, name, reporting(getattr(os, name), watch.note_query)) for name in _ASKS
        ]
        starts = ((threading.Thread, "start"), (_thread, "start_new_thread"))
        replacements += [
            (owner, name, reporting(getattr(owner, name), tell_of_thread)) for owner, name in starts
        ]
        for module, name in _COMPILED_READERS:
            if (owner := sys.modules.get(module)) is not None:
                replacements.append(
                    (owner, name, reporting(getattr(owner, name), watch.note_compiled_read))
                )
        originals = [(owner, name, getattr(owner, name)) for owner, name, _ in replacements]
        for owner, name, value in replacements:
            setattr(owner, name, value)
        try:
            yield
        finally:
            for owner, name, value in originals:
                setattr(owner, name, value)


@contextlib.contextmanager
def watch_reads(rule: str, paths: Iterable[Path] = ()) -> Iterator[RuleWatch]:
    """Context that notes what a rule reads besides the files and folders ``paths``, those of Python
    and of packages."""
    _listen()
    tempfile.gettempdir()  # which reads the environment, once
    watch = RuleWatch(rule, paths)
    outer_watch = _watch()
    with _report_calls(watch):
        _local.watch = watch
        try:
            yield watch
        finally:
            _local.watch = outer_watch


@contextlib.contextmanager
def only_declared(rule: str, paths: Iterable[Path] = ()) -> Iterator[None]:
    """Context in which a rule may read the files and folders ``paths`` only, and those of Python
    and of packages.

    No environment variable, no other program, no network. A temporary file that it makes itself may
    be read.

    Args:
        rule: Name of the rule, for the message.
        paths: Its options of type ``Path``, and the files of its modules.

    Raises:
        UndeclaredError: at the end of the context, if it read something else, also where it caught
            its own error.
    """
    with watch_reads(rule, paths) as watch:
        try:
            yield
        except Exception as e:
            if offence := watch.offence:
                raise UndeclaredError(offence) from e
            raise
    refuse(watch.rule, watch.offence, watch.imported_files)


def refuse(rule: str, offence: str, imported_files: Iterable[Path] = ()) -> None:
    """Raise ``UndeclaredError`` if a rule read something that no option names, or imported unseen
    modules."""
    unseen_files = sorted(map(str, imported_files))
    if unseen_files and not offence:
        offence = (
            f"the seeding rule {rule!r} imports {unseen_files[0]} by a name that it makes while it "
            "runs, so a comparison would keep its old results when that changes; use an import "
            "statement"
        )
    if offence:
        raise UndeclaredError(offence)
