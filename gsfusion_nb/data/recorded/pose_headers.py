"""What comments and headers of a file with poses say of them: where they lead, and the unit of
positions."""

import re
from collections.abc import Iterable
from pathlib import Path

from ...checks import shown
from ...errors import SequenceError

_FROM_WORLD = re.compile(
    r"(?i)world[\s_-]*(to|2)[\s_-]*cam|(?<![a-z])(w2c|t_?cw|cam(era)?_from_world)(?![a-z])"
    r"|view[\s_-]*matri(x|ces)"
)
_TO_WORLD = re.compile(
    r"(?i)cam(era)?[\s_-]*(to|2)[\s_-]*world|(?<![a-z])(c2w|t_?wc|world_from_cam(era)?)(?![a-z])"
)

_UNIT = re.compile(
    r"(?i)(?<![a-z])(?:(mm|millimet(?:re|er)s?)|(cm|centimet(?:re|er)s?)|(inch(?:es)?)|(ft|feet))"
    r"(?![a-z])"
)
_METRES = (0.001, 0.01, 0.0254, 0.3048)
"""Of the groups of ``_UNIT``."""

_ABOUT_POSITIONS = re.compile(
    r"(?i)(?<![a-z])([tp]?_?[xyz]|positions?|translations?|trans|units?)(?![a-z])"
)


def is_header(line: str) -> bool:
    """Whether a line of a file with poses is a comment, or begins with a word."""
    text = line.lstrip("\ufeff \t")
    return text.startswith(("#", "%")) or text[:1].isalpha()


def check_direction(line: str, path: Path) -> None:
    """Raise ``SequenceError`` for a comment or header that says world-to-camera."""
    if is_header(line) and _FROM_WORLD.search(line) and not _TO_WORLD.search(line):
        raise SequenceError(
            f"{path}: {shown(line.strip())} says that its poses are world-to-camera; expected "
            "camera-to-world: invert them, or remove that line if they are"
        )


def metres_per_unit(lines: Iterable[str]) -> float | None:
    """Metres of one unit of the positions, where a comment or header names millimetres,
    centimetres, inches or feet beside positions; else None."""
    for line in lines:
        match = _UNIT.search(line) if is_header(line) and _ABOUT_POSITIONS.search(line) else None
        if match is not None:
            return next(m for m, word in zip(_METRES, match.groups(), strict=True) if word)
    return None


def check_metres(lines: Iterable[str], path: Path) -> None:
    """Raise ``SequenceError`` where a comment or header says that positions are not metres."""
    unit = metres_per_unit(lines)
    if unit is not None:
        raise SequenceError(
            f"{path}: its header says that one unit of its positions is {unit:g} m; expected "
            f"metres: multiply them by {unit:g}, or gsfusion-nb convert {path.parent} OUT"
        )
