"""The backend that was asked for: in a ``with`` block, or by the environment."""

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar

from ..checks import check_name
from .learner import MINE, check_course
from .offers import BACKENDS


def backend_names() -> tuple[str, ...]:
    """What a command can be asked to run on; a Python session that has imported the course also has
    ``mine``."""
    return ("auto", *BACKENDS)


def from_environment() -> str:
    """What the variable GSFUSION_BACKEND asks for, else "auto"."""
    return os.environ.get("GSFUSION_BACKEND", "auto")


_FROM_ENVIRONMENT = from_environment()

choice_of_block: ContextVar[str | None] = ContextVar("gsfusion_backend", default=None)
"""What ``use_backend`` asked for, where a block has begun."""


@contextlib.contextmanager
def use_backend(backend: str) -> Iterator[None]:
    """Run operations on ``backend`` inside the block: "auto", "reference", "numba", "triton",
    "cuda", "mine".

    With "numba", "triton" or "cuda", an operation that this backend does not offer runs on the
    reference. "mine" runs the functions that a learner wrote, and the reference for all other
    operations.

    Raises:
        BackendUnavailable: "mine" where the course is not imported, for instance on the command
            line.
    """
    check_name("backend", backend, (*backend_names(), MINE))
    if backend == MINE:
        check_course()
    token = choice_of_block.set(backend)
    try:
        yield
    finally:
        choice_of_block.reset(token)


def chosen() -> str:
    """The backend that was asked for: by ``use_backend``, else by the environment."""
    return choice_of_block.get() or _FROM_ENVIRONMENT


def runs_learners_code() -> bool:
    """Whether the backend is ``mine``, where any operation may fail because of a learner's
    function."""
    return chosen() == MINE
