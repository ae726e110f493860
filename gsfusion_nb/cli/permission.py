"""Asks before code of others is executed."""

import shlex
import sys
from collections.abc import Iterable, Sequence

from ..errors import SequenceError
from ..seeding.named_code import CodeNotNamedError


def naming_options(error: CodeNotNamedError, options: type) -> list[str]:
    """The arguments by which a command with these options names the code that ``error`` is about;
    empty if it has none.

    Args:
        error: Who asks for what.
        options: Class of the options: with ``rule_file`` or ``system_file`` for files, ``system``
            for FILE.py:Name.
    """
    if hasattr(options, f"{error.kind}_file"):
        files = dict.fromkeys(text.rpartition(":")[0] for text in error.code)
        return [word for file in files for word in (f"--{error.kind}-file", file)]
    return [f"--{error.kind}", *error.code] if hasattr(options, error.kind) else []


def ask_or_refuse(
    error: CodeNotNamedError, prog: str, arguments: Sequence[str], naming: Iterable[str]
) -> None:
    """Return if the user allows, on a terminal, that the code which ``error`` names is executed.

    Args:
        error: Who asks for what.
        prog: The command, such as ``gsfusion-nb map``.
        arguments: Its arguments as they were typed.
        naming: Those that would have named the code.

    Raises:
        SequenceError: the user does not allow it, or there is nobody to ask. It has the command to
            type instead.
    """
    if sys.stdin is not None and sys.stdin.isatty():
        print(f"{error.wish}. Execute it now? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    command = shlex.join([*prog.split(), *arguments, *naming])
    raise SequenceError(f"{error.wish}; if you trust it: {command}") from None
