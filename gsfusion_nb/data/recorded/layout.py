"""What a file in ``readers`` says about the layout that it reads."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..sequence import Sequence


@dataclass(frozen=True, kw_only=True)
class Layout:
    """One way to lay out a sequence on disk."""

    read: Callable[..., Sequence]
    """Reads the folder; its keyword arguments are the options of ``open_sequence`` and of ``--reader``."""
    looks_for: tuple[str, ...]
    """Files and folders by which the layout is recognised, patterns allowed; a folder ends in "/"."""
    locate: Callable[[Path], Path] = lambda path: path
    """The given folder, or the one inside it that holds these files."""
    has_splits: bool = False
    """``read`` takes ``split``, the lists of training and test frames that the data set publishes."""
    registration: Mapping[str, Any] = field(default_factory=dict)
    """Options that register colour to depth, where the layout's files are not registered."""
