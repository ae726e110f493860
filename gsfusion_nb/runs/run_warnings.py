"""What the user of a run should know, as sentences."""

import logging
from collections.abc import Iterable
from typing import Any

log = logging.getLogger(__name__)

_ENDINGS = ("interrupted after ", "interrupted while ", "ended by ")
"""First words of the endings in checkpoints of versions that did not tell them from other
warnings."""


class RunWarnings(list[str]):
    """The sentences in the order in which they came."""

    def __init__(self, sentences: Iterable[str] = ()) -> None:
        super().__init__(sentences)
        self.endings: list[str] = []
        """Those of the sentences that are about how the run ended, or about its map at the end. A
        run that goes on forgets them."""

    def warn(self, sentence: str) -> None:
        """Add a sentence, and log it."""
        self.append(sentence)
        log.warning(sentence)

    def warn_once(self, sentence: str) -> None:
        """Warn, unless the run has said so before."""
        if sentence not in self:
            self.warn(sentence)

    def note_ending(self, sentence: str) -> None:
        """Note how the run ended, or what its map is like at the end."""
        if sentence not in self:
            self.append(sentence)
        if sentence not in self.endings:
            self.endings.append(sentence)

    def go_on(self) -> None:
        """Forget how the run ended, because it goes on."""
        self[:] = [sentence for sentence in self if sentence not in self.endings]
        self.endings = []

    def state_dict(self) -> dict[str, Any]:
        """The sentences, and which of them are endings."""
        return {"warnings": list(self), "endings": list(self.endings)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self[:] = state["warnings"]
        old_endings = [sentence for sentence in self if sentence.startswith(_ENDINGS)]
        self.endings = list(state.get("endings", old_endings))
