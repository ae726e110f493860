"""Code of a seeding rule is executed where the user names its file, and not where somebody else's
file names it.

Settings, checkpoints and tables of comparisons may come from anybody. What they say of a rule in a
file is therefore only a wish: whoever opens them raises ``RuleNotNamedError``, unless the caller
names the same file. A command may then ask on its terminal.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..checks import shown
from ..errors import SequenceError


class RuleNotNamedError(SequenceError):
    """A file asks for code that the user did not name.

    Args:
        asking: The file or folder that asks.
        rules: What it asks for, each as FILE.py:name.
        how: How a caller in Python names them.
    """

    def __init__(self, asking: str | Path, rules: Sequence[str], how: str):
        self.rules = list(rules)
        names = [rule.rpartition(":")[::2] for rule in rules]
        rule_words = " and ".join(
            f"{shown(name)} in {_shown_path(os.path.abspath(file))}" for file, name in names
        )
        self.wish = (
            f"{_shown_path(str(asking))} asks for the seeding rule {rule_words}, whose code is "
            "executed only where the user names it"
        )
        """Who asks for what."""
        super().__init__(f"{self.wish}; if you trust it: {how}")


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
