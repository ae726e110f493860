"""What was marked so far, one line of JSON for each mark: a grading that was stopped goes on where
it was.

A mark is taken again only for the same code of the student, marked by the same program within the
same limits.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ...errors import ArgumentError
from ...files import write_file
from .judge import Limits
from .marks import Mark
from .submission import Cell


def mark_key(
    student: str, exercise: str, cells: Sequence[Cell] | None, limits: Limits, grader: str
) -> str:
    """The same for what gets the same mark.

    Args:
        student: Whose it is.
        exercise: Its name.
        cells: The student's code; ``None`` without any.
        limits: Of time and memory.
        grader: Of the program and where the code runs.
    """
    code = None if cells is None else [[cell.label, cell.source] for cell in cells]
    parts = [student, exercise, code, asdict(limits), grader]
    return hashlib.sha256(json.dumps(parts).encode("utf-8", "surrogatepass")).hexdigest()


class Journal:
    """A file to which marks are added, each at once and for good."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> dict[str, Mark]:
        """The marks by key. A line that was not written to its end is left out.

        Raises:
            ValueError: the file is something else.
        """
        marks: dict[str, Mark] = {}
        if not self.path.exists():
            return marks
        text = self.path.read_text(encoding="utf-8", errors="replace")
        *lines, rest = text.split("\n")
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                marks[entry["key"]] = Mark(**entry["mark"])
            except (ValueError, TypeError, KeyError):
                raise ArgumentError(
                    f"line {number} of {self.path} is no mark; rename the file, or give --no-resume"
                ) from None
        if rest:
            write_file(self.path, "".join(f"{line}\n" for line in lines))
        return marks

    def add(self, key: str, mark: Mark) -> None:
        """Add a mark, readable by the owner only."""
        line = json.dumps({"key": key, "mark": asdict(mark)}, ensure_ascii=True) + "\n"
        descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
