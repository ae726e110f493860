"""What the backend ``mine`` runs: the functions that a learner wrote, with how often each operation ran and how long.

``gsfusion_nb.teaching.mine`` fills ``FUNCTIONS`` from the exercises of the course. An operation without an entry runs
the plain reference.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


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
"""Operation or piece -> the learner's function, with the arguments of the operation. A function that returns
``NotImplemented`` leaves this call to the reference."""

CALLS: dict[str, Calls] = {}
"""Operation or piece -> its calls since the counts were last cleared."""

_thread = threading.local()


def run(name: str, reference: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> Any:
    """Call the learner's function for ``name``, or ``reference``, and count the call."""
    inside = _thread.__dict__.setdefault("seconds_of_called", [])
    inside.append(0.0)
    began, is_own = time.perf_counter(), False
    try:
        own = FUNCTIONS.get(name)
        result = NotImplemented if own is None else own(*args, **kwargs)
        is_own = result is not NotImplemented
        return result if is_own else reference(*args, **kwargs)
    finally:
        took, of_called = time.perf_counter() - began, inside.pop()
        if inside:
            inside[-1] += took
        calls = CALLS.setdefault(name, Calls())
        calls.own += is_own
        calls.reference += not is_own
        calls.seconds += took - of_called
