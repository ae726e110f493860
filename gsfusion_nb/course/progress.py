"""What a learner has done in the course: one JSON file in the user's folder.

The file holds objects by section and name::

    {"format": 1,
     "exercises": {"psnr": {"tries": 2, "passed": "2026-11-22T20:15:00"}},
     "predictions": {"first_seeds": {"question": "...", "answer": 3000, "came": 3812}}}

Sections of other modules are kept as they are. The environment variable ``GSNB_COURSE_FILE`` names
another file. A notebook that is executed to be stored (``GSNB_VIEW=static``) keeps no file: what it
notes ends with the kernel.
"""

import contextlib
import copy
import json
import os
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from platformdirs import user_data_path

from ..errors import ForeseenError, SequenceError
from ..files import read_object, write_file

FORMAT = 1

Entries = dict[str, dict[str, Any]]

_in_memory: dict[str, Any] = {"format": FORMAT}
_messages: set[str] = set()


class CourseFileError(ForeseenError, ValueError):
    """The file cannot be read or written; it was left as it is."""


def course_file() -> Path | None:
    """Where progress is kept; ``None`` in a notebook that is executed to be stored."""
    if path := os.environ.get("GSNB_COURSE_FILE"):
        return Path(path).expanduser()
    if os.environ.get("GSNB_VIEW") == "static":
        return None
    return user_data_path("gsfusion_nb", appauthor=False) / "course.json"


def read_section(section: str) -> Entries:
    """The entries of a section by name; empty if nothing was noted yet.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    return copy.deepcopy(_read().get(section, {}))


def note(section: str, name: str, **values: Any) -> None:
    """Add ``values`` to the entry ``name`` of a section; they replace earlier values of the same
    keys.

    Raises:
        CourseFileError: the file is damaged or newer, or cannot be written. It is unchanged.
    """
    course = _read()
    course.setdefault(section, {}).setdefault(name, {}).update(values)
    _write(course)


def reset() -> Path | None:
    """Start again: the file is renamed, so that nothing is lost. Returns its new name, or ``None``
    without a file."""
    global _in_memory
    _in_memory = {"format": FORMAT}
    path = course_file()
    if path is None or not path.exists():
        return None
    backup = path.with_name(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}{path.suffix}")
    path.rename(backup)
    return backup


def now() -> str:
    """The local time, as the file stores it."""
    return datetime.now().isoformat(timespec="seconds")


@contextlib.contextmanager
def forgiving() -> Iterator[None]:
    """Notes inside the block never stop a notebook: what cannot be kept is said once, in one
    sentence."""
    try:
        yield
    except CourseFileError as e:
        if str(e) not in _messages:
            _messages.add(str(e))
            sys.stdout.write(f"Your progress is not kept: {e}\n")


def read_file(path: Path) -> dict[str, Any]:
    """All sections of a course file.

    Raises:
        CourseFileError: the file is no course file, damaged, or a newer version of the program
            wrote it.
    """
    try:
        course = read_object(path, "the progress of a learner")
    except (SequenceError, OSError) as e:
        raise CourseFileError(f"{path} cannot be read ({e})") from None
    file_format = course.get("format")
    if not isinstance(file_format, int) or file_format > FORMAT:
        raise CourseFileError(
            f"{path} has format {file_format!r}, this version reads {FORMAT}: a newer version "
            "wrote it, or it is another file"
        )
    return course


def _read() -> dict[str, Any]:
    path = course_file()
    if path is None:
        return _in_memory
    if not path.exists():
        return {"format": FORMAT}
    try:
        return read_file(path)
    except CourseFileError as e:
        raise CourseFileError(
            f"{e}. It was left as it is. Rename it, or run  gsfusion-nb course --reset"
        ) from None


def _write(course: dict[str, Any]) -> None:
    path = course_file()
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(course, indent=1, ensure_ascii=False) + "\n")
    except OSError as e:
        raise CourseFileError(f"{path} cannot be written ({e})") from None
