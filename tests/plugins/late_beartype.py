"""beartype that reads a function's annotations at its first call, and looks at every argument once.

Writing the checks of all functions of the package took a third of the time that each test process needs to collect the
tests, and a process calls fewer than half of them.

jaxtyping checks a call with two functions: one that has the parameters of the original and returns ``Any``, before the
call, and after it one with the same parameters and the result. Sizes of axes that the first one has met are known to
the second one, so that it checks the result only.
"""

from collections.abc import Callable
from typing import Any

from beartype import beartype as checked


def beartype(function: Callable) -> Callable:
    """``function`` with its arguments checked, or with its result checked if that is annotated, from its first call."""
    made = None

    def check(*args, **kwargs):
        nonlocal made
        if made is None:
            result = function.__annotations__.get("return", Any)
            if result is not Any:
                function.__annotations__ = {"return": result}
            made = checked(function)
        return made(*args, **kwargs)

    return check
