"""``gsfusion_nb.course`` where a submission runs: there is nothing in it to look up.

The file is copied to ``teaching/__init__.py`` of the installation without solutions.
"""

from typing import Any


class _Exercise:
    """Says nothing; ``working`` gives the function that it is given, or what ``working_of`` puts in its place."""

    def __init__(self, name: str):
        self.name = name

    def __call__(self, function: Any) -> None:
        """No verdict here."""

    def hint(self, number: int | None = None) -> str:
        """No hint here."""
        return ""

    def solution(self) -> str:
        """No solution here."""
        return ""

    def working(self, function: Any, *, plain: bool = False) -> Any:
        """The function with which another exercise goes on."""
        return working_of(self.name, function)


def working_of(name: str, function: Any) -> Any:
    """Replaced while a submission is graded."""
    return function


class _Check:
    def __getattr__(self, name: str) -> _Exercise:
        if name.startswith("_"):
            raise AttributeError(name)
        return _Exercise(name)


check = _Check()


def exercises() -> dict[str, Any]:
    """None here."""
    return {}


def predict(*args: Any, **kwargs: Any) -> None:
    """Asks nothing here."""


def came(*args: Any, **kwargs: Any) -> None:
    """Shows nothing here."""


def course_progress(*args: Any, **kwargs: Any) -> None:
    """Shows nothing here."""
