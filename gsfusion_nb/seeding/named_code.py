"""Code of others is executed where the user names its file, and not where somebody else's file
names it.

Settings, checkpoints and tables of comparisons may come from anybody. What they say of a seeding
rule or a system in a file is therefore only a wish: whoever opens them raises a
``CodeNotNamedError``, unless the caller names the same file. A command may then ask on its
terminal.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar

from ..checks import shown
from ..errors import SequenceError


class CodeNotNamedError(SequenceError):
    """A file asks for code that the user did not name.

    Args:
        asking: The file or folder that asks.
        code: What it asks for, each as FILE.py:name.
        how: How a caller in Python names them.
    """

    kind: ClassVar[str]
    """What the code is, in options: "rule" or "system"."""
    in_words: ClassVar[str]
    """The same in sentences."""

    def __init__(self, asking: str | Path, code: Sequence[str], how: str):
        self.code = list(code)
        names = [text.rpartition(":")[::2] for text in code]
        code_words = " and ".join(
            f"{shown(name)} in {_shown_path(os.path.abspath(os.path.expanduser(file)))}"
            for file, name in names
        )
        self.wish = (
            f"{_shown_path(str(asking))} asks for {self.in_words} {code_words}, whose code is "
            "executed only where the user names it"
        )
        """Who asks for what."""
        super().__init__(f"{self.wish}; if you trust it: {how}")


class RuleNotNamedError(CodeNotNamedError):
    """A file asks for a seeding rule in a file that the user did not name."""

    kind = "rule"
    in_words = "the seeding rule"


class TrainingNotNamedError(CodeNotNamedError):
    """A file asks for a loss or an optimiser in a file that the user did not name."""

    kind = "rule"
    in_words = "the loss or optimiser"


class SystemNotNamedError(CodeNotNamedError):
    """A file asks for a system in a file that the user did not name."""

    kind = "system"
    in_words = "the system"


def is_named(file: str | Path, files: Iterable[str | Path]) -> bool:
    """Whether ``file`` is one of ``files``, whatever the paths look like."""
    path = Path(file).expanduser()
    return path.is_file() and any(
        other.is_file() and other.samefile(path)
        for other in (Path(name).expanduser() for name in files)
    )


def _shown_path(text: str) -> str:
    """A path without characters by which a terminal would show another one."""
    return text if text.isprintable() else repr(text)
