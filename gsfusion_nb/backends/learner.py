"""The backend ``mine``: the reference with the functions of a learner in it.

They replace whole operations, or the parts of an operation that are declared with ``@piece``. It
exists only in a Python session that has imported ``gsfusion_nb.course.learner_backend``.
"""

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .offers import BackendUnavailable
from .registry import LIBRARY

MINE = "mine"
"""The backend that runs the functions of a learner."""


@dataclass
class Calls:
    """How one operation, or one piece of an operation, ran under the backend ``mine``."""

    own: int = 0
    """Calls that the learner's function answered."""
    reference: int = 0
    """Calls that the plain reference answered."""
    seconds: float = 0.0
    """Wall time of all calls, without the time of other operations that they called."""


FUNCTIONS: dict[str, Callable[..., Any]] = {}
"""Operation or piece -> the learner's function, with the arguments of the operation. A function
that returns ``NotImplemented`` leaves this call to the reference."""

CALLS: dict[str, Calls] = {}
"""Operation or piece -> its calls since the counts were last cleared."""

_thread = threading.local()


def run_counted(
    name: str,
    reference: Callable[..., Any],
    args: tuple,
    kwargs: dict[str, Any],
) -> Any:
    """Call the learner's function for ``name``, or ``reference``, and count the call."""
    durations = _thread.__dict__.setdefault("seconds_of_called", [])
    durations.append(0.0)
    began = time.perf_counter()
    is_own = False
    try:
        own = FUNCTIONS.get(name)
        result = NotImplemented if own is None else own(*args, **kwargs)
        is_own = result is not NotImplemented
        return result if is_own else reference(*args, **kwargs)
    finally:
        took = time.perf_counter() - began
        of_called = durations.pop()
        if durations:
            durations[-1] += took
        calls = CALLS.setdefault(name, Calls())
        calls.own += is_own
        calls.reference += not is_own
        calls.seconds += took - of_called


def check_course() -> None:
    """Raise ``BackendUnavailable`` unless this Python session can have functions of a learner."""
    if f"{LIBRARY}.course.learner_backend" not in sys.modules:
        raise BackendUnavailable(
            f"backend {MINE!r} runs functions that a learner wrote in a notebook of the course, "
            "and this program has none; use it in a notebook, after "
            "`from gsfusion_nb.course import mine`"
        )
