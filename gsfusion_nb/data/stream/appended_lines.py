"""The lines of a text file that another program is appending to."""

from pathlib import Path

from ...foreign import TEXT_BYTES, open_regular
from ..sequence import SequenceError


class AppendedLines:
    """Lines by number, from 0; empty lines and ``#`` comments do not count. A line counts when its line end is written.

    Each ``update`` reads what was appended since the last one. A file that has become shorter was rewritten; it is read
    from its beginning, and the numbers start from 0 again.
    """

    def __init__(self, path: Path):
        self.path = path
        self.n_lines = 0
        """Lines seen so far."""
        self._lines: dict[int, str] = {}
        self._wanted = 0
        self._read_bytes = 0
        self._rest = b""

    def update(self, *, final: bool = False) -> bool:
        """Read the new lines; ``final`` counts a last line without line end. Returns whether anything was new."""
        try:
            size = self.path.stat().st_size
            if size < self._read_bytes:
                self._read_bytes, self._rest, self.n_lines = 0, b"", 0
                self._lines.clear()
            with open_regular(self.path, "lines of text") as file:
                file.seek(self._read_bytes)
                new = file.read(TEXT_BYTES)
        except (OSError, SequenceError):
            return False
        self._read_bytes += len(new)
        *whole, self._rest = (self._rest + new).split(b"\n")
        if final and self._rest:
            whole, self._rest = [*whole, self._rest], b""
        for line in whole:
            self._add(line.decode("utf-8-sig", errors="replace").strip())
        return bool(new)

    def take(self, n: int) -> str | None:
        """Line ``n``, or None if it is not written yet; earlier lines are dropped."""
        for earlier in range(self._wanted, n):
            self._lines.pop(earlier, None)
        self._wanted = max(self._wanted, n)
        return self._lines.get(n)

    def _add(self, line: str) -> None:
        if line and not line.startswith("#"):
            if self.n_lines >= self._wanted:
                self._lines[self.n_lines] = line
            self.n_lines += 1
