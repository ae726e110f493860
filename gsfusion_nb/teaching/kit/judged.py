"""Everything that a checker finds in a function, not only the first property that fails."""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from ..attempt import Attempt, Failed, NotWritten
from ..exercise import Exercise
from ..whose import judging

_STATEMENTS = ("close", "holds")
"""With these a judge states a property. What fails in another way ends the judgement."""


@dataclass
class Judged:
    """What a judge found in one function."""

    broken: list[Failed] = field(default_factory=list)
    """Properties that failed, the first one first."""
    held: list[str] = field(default_factory=list)
    """Properties that were tested and never failed."""
    right_on: list[str] = field(default_factory=list)
    """Inputs, in words, for which every tested property holds."""


def judge_thoroughly(exercise: Exercise, function: Callable[..., Any]) -> Judged:
    """Run the judge of an exercise on a function to its end, or to an error from which it cannot go on.

    Raises:
        ValueError: no property fails, so the function is no wrong answer.
    """
    found = Judged()
    with _collecting(inspect.unwrap(exercise.judge).__globals__, found), judging(exercise.name):
        try:
            exercise.judge(Attempt(function))
        except Failed as e:
            found.broken.append(e)
        except NotWritten:
            raise ValueError(f"{exercise.name}: the function is not written") from None
        except Exception:
            if not found.broken:
                raise
    if not found.broken:
        raise ValueError(f"{exercise.name}: {function.__name__} passes, so it is no wrong answer")
    props = {e.prop for e in found.broken}
    found.held = [prop for prop in dict.fromkeys(found.held) if prop not in props]
    wrong_on = {e.on for e in found.broken}
    found.right_on = [on for on in dict.fromkeys(found.right_on) if on not in wrong_on]
    return found


@contextmanager
def _collecting(module: dict[str, Any], found: Judged) -> Iterator[None]:
    """Within the block, the statements of a chapter's judges note a failure and go on."""

    def noting(statement: Callable[..., None]) -> Callable[..., None]:
        def noted(*args: Any, **kwargs: Any) -> None:
            prop = kwargs.get("prop", args[{"close": 2, "holds": 1}[statement.__name__]])
            try:
                statement(*args, **kwargs)
            except Failed as e:
                found.broken.append(e)
            else:
                found.held.append(prop)
                found.right_on.append(kwargs["on"])

        return noted

    original = {name: module[name] for name in _STATEMENTS if name in module}
    module.update({name: noting(statement) for name, statement in original.items()})
    try:
        yield
    finally:
        module.update(original)
