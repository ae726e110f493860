"""A number that could not be computed, with the reason; it prints as a sentence."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NotComputed:
    """Used in place of a number. In JSON it is ``{"not_computed": reason}``."""

    reason: str
    """The reason, without a full stop."""

    def __str__(self) -> str:
        return f"not computed: {self.reason}"

    def as_json(self) -> dict[str, str]:
        """The form in metrics.json."""
        return {"not_computed": self.reason}
