"""Points of exercises: by difficulty, or as a table says."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

from ...errors import SequenceError
from ...foreign import read_bytes
from ..exercise import DIFFICULTIES, Exercise, exercises

BY_DIFFICULTY = {1: 1.0, 2: 2.0, 3: 3.0, 4: 5.0, 5: 8.0}


class Points:
    """The most points of each exercise.

    Args:
        by_difficulty: Difficulty, 1 to 5, -> points.
        by_name: Name of an exercise -> points, which come before those of its difficulty.
    """

    def __init__(self, by_difficulty: Mapping[int, float] = BY_DIFFICULTY, by_name: Mapping[str, float] | None = None):
        self.by_difficulty, self.by_name = {**BY_DIFFICULTY, **by_difficulty}, dict(by_name or {})

    def of(self, exercise: Exercise) -> float:
        """The most points of ``exercise``."""
        return self.by_name.get(exercise.name, self.by_difficulty[exercise.difficulty])


def read_points(path: Path) -> Points:
    """Points from a TOML file: ``[difficulty]`` with ``1 = 2.0``, ``[exercise]`` with ``psnr = 4``; both are optional.

    Raises:
        ValueError: it is not such a file; the message says which entry.
    """
    try:
        table = tomllib.loads(read_bytes(path, "a table of points").decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, SequenceError) as e:
        raise ValueError(f"{path}: {e}") from None
    unknown = set(table) - {"difficulty", "exercise"}
    if unknown:
        raise ValueError(f"{path}: unknown section {sorted(unknown)[0]!r}; there are difficulty and exercise")
    known = {"difficulty": {str(d) for d in DIFFICULTIES}, "exercise": set(exercises())}
    for section, names in known.items():
        for name, value in table.get(section, {}).items():
            if name not in names:
                raise ValueError(f"{path}: there is no {section} {name!r}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1e6:
                raise ValueError(f"{path}: the points of {section} {name} must be a number from 0 on, got {value!r}")
    by_difficulty = {int(d): float(v) for d, v in table.get("difficulty", {}).items()}
    return Points(by_difficulty, {name: float(v) for name, v in table.get("exercise", {}).items()})
