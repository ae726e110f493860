"""Exercises and their checkers. A notebook imports ``check``; a chapter's module registers
exercises.

In a notebook::

    from gsfusion_nb.course import check
    check.lift_pixel                 # title, difficulty, minutes, number of hints
    check.lift_pixel.hint()          # the next hint, on request
    check.lift_pixel(lift_pixel)     # Verdict: green, or red with the failed property and the input
    check.lift_pixel.solution()      # source of a solution, after the first try
    f = check.lift_pixel.working(f)  # the student's function if it passes, else the reference's;
                                     # it says whose

In ``course/<chapter>.py`` (found automatically, nothing to register elsewhere)::

    def _solution(camera, uv, depth_m): ...
    def _along_the_ray(camera, uv, depth_m): ...            # a plausible wrong answer

    @exercise(
        chapter=1, difficulty=2, minutes=10, solution=_solution,
        hints=("What is z of the point?", "Multiply the ray by the depth."),
        wrong=(Wrong(_along_the_ray, says="the depth is the point's z"),),
    )
    def lift_pixel(attempt: Attempt) -> None:               # the name of the exercise
        \"\"\"Lift a pixel with its depth to a point.\"\"\"      # its title
        attempt.on("a corner pixel at 2 m")
        point = attempt(camera, uv, depth_m)                # copies tensors, catches errors
        attempt.close(point, expected, "the depth is the point's z")

The judge returns nothing and raises ``Failed`` (through ``close``, ``holds`` and ``unpack`` of the
attempt) at the first property that does not hold; put the property that explains most mistakes
first. Tests run every judge on its solution, which must pass, on every wrong answer, which must
fail and say ``says``, and on an unwritten body.

A judged function runs with a limit of time (``learner_code.py``).

A function that passes is kept (``course.mine``). ``becomes=Becomes("lift", adapter)`` says which
operation of the library it replaces under the backend ``mine``;
``adapter(yours, *arguments of the operation)`` calls it.
"""

import contextlib
import importlib
import inspect
import pkgutil
import re
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..backends import use_backend
from ..errors import ArgumentError
from .attempt import Attempt as Attempt
from .attempt import Failed as Failed
from .attempt import LocalSubject, NotWritten, Subject, describe
from .kept_functions import keep_source
from .learner_code import with_reference
from .learner_operation import Becomes as Becomes
from .learner_operation import Yours as Yours
from .learner_operation import remember
from .progress import forgiving, note, now, read_section
from .verdict import Verdict

DIFFICULTIES = {1: "warm-up", 2: "easy", 3: "medium", 4: "hard", 5: "challenge"}

_EXERCISES: dict[str, "Exercise"] = {}


class Said(str):
    """A text, which a notebook shows without quotation marks."""

    __repr__ = str.__str__


def source_of(
    exercise: str,
    function: Callable[..., Any],
    exclude: Callable[..., Any] | None = None,
) -> str:
    """Source of a function under the exercise's name, after the private functions of its module
    that it calls, but not ``exclude``."""
    sources = [
        inspect.getsource(each) for each in [*_called_by(function, {function, exclude}), function]
    ]
    source = re.sub(rf"\b{re.escape(function.__name__)}\b", exercise, sources[-1])
    return "\n\n".join([*sources[:-1], source]).strip()


def _called_by(
    function: Callable[..., Any],
    visited: set[Any],
) -> Iterator[Callable[..., Any]]:
    plain = inspect.unwrap(function)
    code = getattr(plain, "__code__", None)
    names = code.co_names if code is not None else ()
    for name in names:
        other = getattr(plain, "__globals__", {}).get(name)
        if not isinstance(other, types.FunctionType) or other in visited:
            continue
        if name.startswith("_") and other.__module__ == function.__module__:
            visited.add(other)
            yield from _called_by(other, visited)
            yield other


@dataclass(frozen=True)
class Wrong:
    """A plausible wrong answer, and words that the verdict on it must contain."""

    function: Callable[..., Any]
    says: str


@dataclass(eq=False, kw_only=True)
class Exercise:
    """One exercise. Calling it with a function judges that function."""

    name: str
    title: str
    chapter: int
    difficulty: int
    minutes: int
    hints: tuple[str, ...]
    judge: Callable[[Attempt], None]
    _solution: Callable[..., Any]
    wrong: tuple[Wrong, ...]
    becomes: Becomes | None = None
    replaces: tuple[Callable[..., Any], ...] = ()
    goes_on_with: tuple[str, ...] = ()
    hints_given: int = 0
    tries: int = 0
    """Functions of this exercise's name that were judged in this process; unwritten ones do not
    count."""

    def __call__(self, function: Any) -> Verdict:
        """The verdict on ``function``: passed, failed (which property, on what input), or not
        written."""
        verdict = self._judge(function)
        own = getattr(function, "__name__", "") in (self.name, "<lambda>")
        if verdict or (verdict.state == "failed" and own):
            self.tries += 1
            with forgiving():
                entry = read_section("exercises").get(self.name, {})
                tries = int(entry.get("tries", 0)) + 1
                note("exercises", self.name, tries=tries)
                if verdict and "passed" not in entry:
                    note("exercises", self.name, passed=now())
        return verdict

    def _judge(self, function: Any) -> Verdict:
        verdict = self.verdict(function)
        if verdict:
            remember(self.name, self.becomes, function)
            with forgiving():
                keep_source(self.name, function)
        return verdict

    def verdict(self, function: Any) -> Verdict:
        """The verdict on ``function``, which is neither counted nor kept."""
        if not callable(function):
            return self._verdict(
                state="failed", prop="it is a function", detail=f"got a {type(function).__name__}"
            )
        return self.verdict_on(LocalSubject(function))

    def verdict_on(self, subject: Subject) -> Verdict:
        """The verdict on a learner's function, which may be in another process."""
        attempt = Attempt(subject)
        try:
            with use_backend("reference") if self.becomes else contextlib.nullcontext():
                self.judge(attempt)
            attempt.not_borrowed(self.replaces)
        except NotWritten:
            return self._verdict(state="not written", detail="the function returns nothing so far")
        except Failed as e:
            return self._verdict(state="failed", prop=e.prop, on=e.on, detail=e.detail)
        except (
            Exception
        ) as e:  # the judge did something with the result that such a result cannot do
            prop = "it returns what the function's first line asks for"
            message = f"{type(e).__name__}: {str(e).splitlines()[0] if str(e) else ''}"
            detail = (
                f"it returned {describe([attempt.returned])}, with which the checker could "
                f"not go on ({message})"
            )
            return self._verdict(state="failed", prop=prop, on=attempt.words, detail=detail)
        return Verdict(exercise=self.name, state="passed")

    def _verdict(self, **what: Any) -> Verdict:
        hints_left = len(self.hints) - self.hints_given
        return Verdict(exercise=self.name, hints_left=hints_left, **what)

    def hint(self, number: int | None = None) -> Said:
        """The next hint, or hint ``number`` (from 1); after the last one, the last one again."""
        last = self.hints_given + 1 if number is None else number
        last = min(max(last, 1), len(self.hints))
        self.hints_given = max(self.hints_given, last)
        return Said(f"Hint {last} of {len(self.hints)}: {self.hints[last - 1]}")

    def solution(self) -> Said:
        """Source code of a solution; before the first try, a sentence that says what to do."""
        entry: dict[str, Any] = {}
        with forgiving():
            entry = read_section("exercises").get(self.name, {})
        if not (self.tries or entry.get("tries", 0)):
            more = (
                f" Before that: check.{self.name}.hint()"
                if self.hints_given < len(self.hints)
                else ""
            )
            return Said(
                f"The solution of {self.name} opens after your first try: write the function and "
                f"run check.{self.name}({self.name}).{more}"
            )
        return Said(source_of(self.name, self._solution))

    def working(
        self,
        function: Any,
        *,
        plain: bool = False,
    ) -> Callable[..., Any]:
        """``function`` if it passes, otherwise the reference's, so that the chapter can go on; one
        sentence says whose.

        If the student's function raises in a later call, the sentence names its line and the
        reference's goes on.

        Args:
            function: The student's.
            plain: Return the function itself, for a compiler such as numba; its errors stop the
                cell.
        """
        verdict = self._judge(function)
        verdict.code_in_use.tell()
        if not verdict:
            return self._solution
        return function if plain else with_reference(self.name, function, self._solution)

    def __repr__(self) -> str:
        stars = "★" * self.difficulty + "☆" * (5 - self.difficulty)
        return (
            f"{self.name}: {self.title} {stars} {DIFFICULTIES[self.difficulty]}, about "
            f"{self.minutes} minutes, {len(self.hints)} hints"
        )


def exercise(
    *,
    chapter: int,
    difficulty: int,
    minutes: int,
    hints: Sequence[str],
    solution: Callable[..., Any],
    wrong: Sequence[Wrong],
    becomes: Becomes | None = None,
    replaces: Sequence[Callable[..., Any]] = (),
    goes_on_with: Sequence[str] = (),
) -> Callable[[Callable[[Attempt], None]], Exercise]:
    """Register the decorated judge as the exercise of its name; the first line of its docstring is
    the title.

    Args:
        chapter: Number of the chapter.
        difficulty: 1 to 5.
        minutes: What it takes, as the course estimates it.
        hints: In the order in which they are given.
        solution: A right answer, which the judge accepts.
        wrong: Plausible wrong answers, which the judge refuses.
        becomes: What the function becomes in the library.
        replaces: Functions of the library that it must not call.
        goes_on_with: Exercises whose working function it is given by the notebook
            (``check.<name>.working``).

    Raises:
        ValueError: unknown difficulty, no hint, no wrong answer, no title, or a name that another
            module uses.
    """

    def register(judge: Callable[[Attempt], None]) -> Exercise:
        name = judge.__name__
        title = (judge.__doc__ or "").strip().splitlines()[:1]
        if difficulty not in DIFFICULTIES:
            raise ArgumentError(
                f"exercise {name}: difficulty must be one of {list(DIFFICULTIES)}, got {difficulty}"
            )
        if not hints or not wrong or not title:
            raise ArgumentError(
                f"exercise {name} needs a docstring, at least one hint and at least one wrong "
                "answer"
            )
        other = _EXERCISES.get(name)
        if other is not None and other.judge.__module__ != judge.__module__:
            raise ArgumentError(f"exercise {name} exists already in {other.judge.__module__}")
        _EXERCISES[name] = Exercise(
            name=name,
            title=title[0],
            chapter=chapter,
            difficulty=difficulty,
            minutes=minutes,
            hints=tuple(hints),
            judge=judge,
            _solution=solution,
            wrong=tuple(wrong),
            becomes=becomes,
            replaces=tuple(replaces),
            goes_on_with=tuple(goes_on_with),
        )
        return _EXERCISES[name]

    return register


def exercises() -> dict[str, Exercise]:
    """Every exercise of the course by name; loads the modules of this folder, which register
    them."""
    package = importlib.import_module(__package__ or "")
    for module in pkgutil.iter_modules(package.__path__):
        if not module.ispkg:
            importlib.import_module(f"{package.__name__}.{module.name}")
    return dict(
        sorted(
            _EXERCISES.items(),
            key=lambda item: (item[1].chapter, item[0]),
        )
    )


class Checkers:
    """``check.<name>`` is the exercise of that name; tab completion lists them."""

    def __getattr__(self, name: str) -> Exercise:
        if name.startswith("_"):
            raise AttributeError(name)
        all_exercises = exercises()
        if name not in all_exercises:
            raise AttributeError(f"no exercise {name!r}; there are: {', '.join(all_exercises)}")
        return all_exercises[name]

    def __dir__(self) -> list[str]:
        return list(exercises())

    def __repr__(self) -> str:
        return "\n".join(map(repr, exercises().values()))


check = Checkers()
