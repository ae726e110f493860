"""One sequence of a data set on disk: a test that it can be read, and the command that maps it."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..open import open_sequence
from ..sequence import SequenceError
from .errors import FetchError


@dataclass(frozen=True, kw_only=True)
class SequenceOnDisk:
    """One sequence of a data set and its options."""

    path: str = "."
    """Folder inside the data set's folder."""
    format: str = "auto"
    preset: str
    reader: dict[str, Any] = field(default_factory=dict)
    """Options of the layout's reader."""

    def command(self, folder: Path) -> str:
        """The command that maps it."""
        words = ["gsfusion-nb", "map", str(folder / self.path), "--preset", self.preset]
        if self.format != "auto":
            words += ["--format", self.format]
        if self.reader:
            words += ["--reader", *(f"{name}={str(value).lower()}" for name, value in self.reader.items())]
        return shlex.join(words)

    def prove(self, folder: Path) -> str:
        """Open it and decode its first and last frame; returns a line that describes it.

        Raises:
            FetchError: the reader refuses it.
        """
        place = folder / self.path
        try:
            sequence = open_sequence(place, format=self.format, **self.reader)
            first, last = sequence[0], sequence[len(sequence) - 1]
        except SequenceError as e:
            raise FetchError(f"what was fetched cannot be read as a sequence: {e}") from None
        depth_m = first.depth_m[first.depth_m > 0]
        seen = float((last.depth_m > 0).float().mean())
        return (
            f"{sequence.name}: {len(sequence)} frames of {first.camera.width}x{first.camera.height}, depth around "
            f"{float(depth_m.median()):.2f} m in the first, at {100 * seen:.0f} % of the pixels of the last"
        )
