"""The course without its exercises, as a submission sees it: ``check.<name>.working`` gives a
function that the judge computes, for exercises on which this one builds; all else does nothing."""

from typing import Any

__all__ = ["came", "check", "course_progress", "exercises", "mine", "predict"]


class Nothing:
    """Takes every call and every name, and gives itself; false."""

    def __call__(self, *args: Any, **kwargs: Any) -> "Nothing":
        return self

    def __getattr__(self, name: str) -> "Nothing":
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __bool__(self) -> bool:
        return False

    def __repr__(self) -> str:
        return "(not while marks are given)"


class Check(Nothing):
    """``check.<exercise>`` while marks are given."""

    def __init__(self, exercise: str):
        self.exercise = exercise

    def working(self, function: Any, *, plain: bool = False) -> Any:
        """The reference's function, which the judge computes; ``function`` itself where this
        exercise does not build on it."""
        from .grading import answering  # pyright: ignore[reportMissingImports]

        return answering.reference_of(self.exercise) or function


class Checks:
    """``check`` while marks are given."""

    def __getattr__(self, name: str) -> Check:
        if name.startswith("_"):
            raise AttributeError(name)
        return Check(name)


check = Checks()
came = predict = course_progress = mine = Nothing()


def exercises() -> dict[str, Any]:
    """None."""
    return {}
