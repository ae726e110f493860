"""The verdict on a learner's function, as a notebook shows it."""

from dataclasses import dataclass
from typing import Literal

from ..drawing.page import fill
from .learner_code import CodeInUse

_COLOURS = {"passed": "#1a7f37", "failed": "#c62828", "not written": "#6e7781"}
_SIGNS = {"passed": "✓", "failed": "✗", "not written": "…"}


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The answer of ``check.<name>(fn)``; true if everything holds. Notebooks show it in colour."""

    exercise: str
    """Name of the exercise."""
    state: Literal["passed", "failed", "not written"]
    prop: str = ""
    """The property that failed."""
    on: str = ""
    """The input on which it failed, in words."""
    detail: str = ""
    """What was returned and what was expected; or, when passed, what was checked."""
    hints_left: int = 0
    """Hints not yet asked for."""

    def __bool__(self) -> bool:
        return self.state == "passed"

    @property
    def code_in_use(self) -> CodeInUse:
        """Whose code a chapter goes on with, after this verdict on the learner's function."""
        if self:
            return CodeInUse(exercise=self.exercise, state="yours")
        if self.state == "not written":
            return CodeInUse(exercise=self.exercise, state="not yet yours", why="not yet yours.")
        case = f" (on {self.on})" if self.on else ""
        return CodeInUse(
            exercise=self.exercise,
            state="fails",
            why=f"yours fails “{self.prop}”{case}: {self.detail}",
        )

    @property
    def headline(self) -> str:
        """One line without the details."""
        if self.state == "failed":
            return f"{_SIGNS['failed']} {self.exercise}: not true yet: “{self.prop}”"
        return (
            f"{_SIGNS[self.state]} {self.exercise}: "
            f"{self.state if self.state == 'not written' else 'all checks pass'}"
        )

    @property
    def lines(self) -> list[str]:
        """What follows the headline."""
        rest = [f"input: {self.on}"] if self.on else []
        if self.detail:
            rest.append(self.detail)
        if not self and self.hints_left:
            rest.append(
                f"{self.hints_left} hint{'s' if self.hints_left > 1 else ''}: "
                f"check.{self.exercise}.hint()"
            )
        elif self.state == "failed":
            rest.append(f"a solution: check.{self.exercise}.solution()")
        return rest

    def __repr__(self) -> str:
        return "\n  ".join([self.headline, *self.lines])

    def _repr_html_(self) -> str:
        return fill("verdict.html", verdict=self, colour=_COLOURS[self.state])
