"""A number that could not be computed, with the reason: it prints as a sentence and is never mistaken for a value."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NotComputed:
    """Takes the place of a number. In JSON it is ``{"not_computed": reason}``."""

    reason: str
    """Why, as a short clause without a full stop."""

    def __str__(self) -> str:
        return f"not computed: {self.reason}"

    def as_json(self) -> dict[str, str]:
        """The form that goes into metrics.json."""
        return {"not_computed": self.reason}
