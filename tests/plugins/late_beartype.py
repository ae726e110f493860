"""beartype that reads a function's annotations at its first call.

Writing the checks of all functions of the package took a third of the time that each test process needs to collect the
tests, and a process calls fewer than half of them.
"""

from collections.abc import Callable

from beartype import beartype as checked


def beartype(function: Callable) -> Callable:
    """``function`` with its arguments and its result checked, from its first call."""
    made = None

    def check(*args, **kwargs):
        nonlocal made
        made = made or checked(function)
        return made(*args, **kwargs)

    return check
