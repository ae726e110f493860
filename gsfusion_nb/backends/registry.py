"""The operations that were declared so far, and the parts of them that a learner can replace."""

from collections.abc import Callable

from ..checks import check_name

LIBRARY = __name__.split(".")[0]
"""This package."""

KERNELS = f"{LIBRARY}.kernels"
"""The package of the kernels."""

OPERATIONS: dict[str, Callable] = {}
"""Operation -> its reference."""

FOLDERS: dict[str, str] = {}
"""Operation -> package of its kernels, which has a module per backend that offers it:
``<package>.<backend>``."""

PIECES: dict[str, Callable] = {}
"""Part of an operation -> the plain function of it."""


def reference_of(name: str) -> Callable:
    """The plain function of an operation, or of a piece of one.

    Raises:
        UnknownNameError: there is none.
    """
    functions = OPERATIONS | PIECES
    check_name("operation", name, functions)
    return functions[name]
