"""Who asked for something: the modules and functions on the stack, from where the guard of a rule
was called."""

import itertools
import sys
from collections.abc import Iterator
from types import FrameType

from ..code_keys.origin import CHECKS_TYPES, OWN_PACKAGE, is_library_namespace

_GUARD = {f"{__package__}.{file}" for file in ("callers", "rule_guard", "rule_watch")}
"""Modules that look at the stack themselves, and are no callers."""
_ONLY_NAMES = {
    "resolve",
    "realpath",
    "_joinrealpath",
    "checkcache",
    "updatecache",
    "getsourcefile",
    "rmtree",
}
"""Functions of Python that ask so on the way to a path's full name, a message's source line, or to
remove something."""

_OF_MESSAGES = {"traceback", "inspect", "warnings"}
"""Modules of Python that show source lines."""


def _frames() -> Iterator[FrameType]:
    """The frames on the stack, the nearest first, from where the guard was called."""
    frame: FrameType | None = sys._getframe(1)
    is_guard = True
    while frame is not None:
        name = _module_of(frame)
        is_guard = is_guard and (name in _GUARD or name.startswith(CHECKS_TYPES))
        if not is_guard:
            yield frame
        frame = frame.f_back


def _module_of(frame: FrameType) -> str:
    return frame.f_globals.get("__name__") or ""


def functions() -> Iterator[tuple[str, str]]:
    """Module and name of the functions on the stack, the nearest first."""
    for frame in _frames():
        yield _module_of(frame), frame.f_code.co_name


def is_only_a_name() -> bool:
    """Whether Python asks of a file only to find its full name, the line of a message, or to remove
    it."""
    of_python = itertools.takewhile(
        lambda function: function[0].partition(".")[0] in sys.stdlib_module_names, functions()
    )
    return any(name in _ONLY_NAMES for _, name in of_python)


def is_for_a_message() -> bool:
    """Whether a source line is read for a message, or by a library; not by the rule's own code."""
    of_python = itertools.takewhile(
        lambda function: function[0].partition(".")[0] in sys.stdlib_module_names, functions()
    )
    return caller() != "" or any(module in _OF_MESSAGES for module, _ in of_python)


def asker() -> str:
    """Name of the module whose code made the call itself."""
    return next((_module_of(frame) for frame in _frames()), "")


def caller() -> str:
    """Name of the package whose function asked for it: the nearest on the stack that is not
    Python's own; empty for somebody's own code."""
    for frame in _frames():
        top = _module_of(frame).partition(".")[0]
        if top not in sys.stdlib_module_names:
            return top if is_library_namespace(frame.f_globals) else ""
    return "python"


def is_for_package() -> bool:
    """Whether this package asked for it, through whatever library, and not the rule's own code."""
    for frame in _frames():
        if _module_of(frame).startswith(f"{OWN_PACKAGE}."):
            return True
        if not is_library_namespace(frame.f_globals):
            return False
    return True
