"""jaxtyping that checks the first calls of each function in each test, instead of every call.

Checking every call doubled the time of the tests. What is checked is made at the first call,
because a process calls fewer than half of the package's functions. Functions inside functions are
not checked: they would be made anew in every call. The name begins with jaxtyping for
``gsfusion_nb.course.learner_code``, which looks past such frames.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jaxtyping

CALLS = 2
"""Of each function in each test that are checked."""
_every_call = jaxtyping.jaxtyped
_test = 0


def next_test() -> None:
    """From now on each function is checked again."""
    global _test
    _test += 1


def jaxtyped(thing: Any = None, *, typechecker: Callable) -> Any:
    """As ``jaxtyping.jaxtyped``, which it replaces; also for a dataclass, of which ``__init__`` is
    checked."""
    if thing is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if isinstance(thing, type):
        if dataclasses.is_dataclass(thing) and "__init__" in vars(thing):
            thing.__init__ = _sampled(thing.__init__, typechecker)
        return thing
    if "<locals>" in getattr(thing, "__qualname__", "<locals>"):
        return thing
    return _sampled(thing, typechecker)


def _sampled(function: Callable, typechecker: Callable) -> Callable:
    checked = None
    test = -1
    left = 0

    @functools.wraps(function)
    def call(*args, **kwargs):
        nonlocal checked, test, left
        if test != _test:
            test = _test
            left = CALLS
        if not left:
            return function(*args, **kwargs)
        left -= 1
        if checked is None:
            checked = _every_call(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call


jaxtyping.jaxtyped = jaxtyped
