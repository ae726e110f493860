"""The hidden test in an exported notebook, and the marks that the plug-ins of nbgrader and Otter put in its place.

A test in the notebook's own kernel cannot be safe from what the notebook does to that kernel. So the plug-ins never run
a submission in a kernel; the function here is for those who run an exported notebook without them.
"""

import functools
import logging
from collections.abc import Sequence
from typing import Any

from ..attempt import Verdict
from ..exercise import exercises
from ..sandbox.needed import Cell
from .isolated import Sandbox, unprotected
from .marking import verdict_on, why
from .remote import Limits

log = logging.getLogger(__name__)


@functools.cache
def _warn() -> None:
    """Say once what is not guarded here."""
    if unprotected():
        log.warning(unprotected())


def marked(names: Sequence[str], cells: Sequence[Cell], seed: int, limits: Limits) -> dict[str, Verdict]:
    """The verdicts on the functions in the cells of one submission, in the sandbox."""
    _warn()
    verdicts: dict[str, Verdict] = {}
    with Sandbox(limits) as sandbox:
        for name in names:
            accepted = frozenset(n for n, verdict in verdicts.items() if verdict)
            with sandbox.function(name, cells, accepted) as function:
                verdicts[name] = verdict_on(exercises()[name], function, seed)
    return verdicts


def sentence(verdict: Verdict) -> str:
    """What a student reads about an answer that is not right."""
    prop, message = why(verdict)
    return f"not true yet: “{prop}”; {message}"


def hidden_test(name: str, function: Any, history: Sequence[str], *, seed: int) -> bool:
    """Judge ``name`` as it was written in the cells run so far, in a process of its own.

    Args:
        name: Exercise.
        function: The student's; it must exist, and is not called here.
        history: ``In`` of the notebook.
        seed: Of the hidden inputs.

    Raises:
        AssertionError: a property does not hold.
    """
    cells = [Cell(f"cell [{i}]", source) for i, source in enumerate(history)]
    verdict = marked([name], cells, seed, Limits())[name]
    if not verdict:
        raise AssertionError(sentence(verdict))
    return True
