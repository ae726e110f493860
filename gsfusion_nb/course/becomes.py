"""What the function of an exercise becomes in the library, and the accepted functions that are kept for it."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..backends import FUNCTIONS
from .yours import Yours

KEPT: dict[str, Callable[..., Any]] = {}
"""Exercise -> the learner's newest accepted function."""


@dataclass(frozen=True)
class Becomes:
    """What a function becomes under the backend ``mine``: an operation of the library, or a piece of one."""

    operation: str
    """Name of the function with ``@op`` or ``@piece``."""
    adapter: Callable[..., Any]
    """Takes the learner's function (``Yours``) and the arguments of the operation; returns what the operation returns,
    or ``NotImplemented`` to leave this call to the reference."""


def remember(exercise: str, becomes: Becomes | None, function: Callable[..., Any]) -> None:
    """Keep ``function`` for an exercise, in place of an earlier one."""
    KEPT[exercise] = function
    if becomes is not None:
        yours = Yours(exercise, becomes.operation, function)
        FUNCTIONS[becomes.operation] = functools.partial(becomes.adapter, yours)
