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

_OTHER_AXES = re.compile(
    r"(?i)(?<![a-z])(opengl|blender|unity|left[\s_-]*handed|right[\s_-]*up[\s_-]*back|y[\s_-]*up)"
    r"(?![a-z])"
)
_OPENCV = re.compile(r"(?i)opencv|right[\s_-]*down[\s_-]*forward")

_OF_COLMAP = re.compile(r"(?i)POINTS2D|IMAGE_ID.*CAMERA_ID")

_UNIT = re.compile(
    r"(?i)(?<![a-z])(?:(mm|millimet(?:re|er)s?)|(cm|centimet(?:re|er)s?)|(inch(?:es)?)|(ft|feet))"
    r"(?![a-z])"
)
_METRES = (0.001, 0.01, 0.0254, 0.3048)
"""Of the groups of ``_UNIT``."""

_ABOUT_POSITIONS = re.compile(
    r"(?i)(?<![a-z])([tp]?_?[xyz]|positions?|translations?|trans|units?)(?![a-z])"
)


_LOST = re.compile(r"(?i)[-+]?1\.#(inf|ind|qnan|snan)\d*")


def with_nan(text: str) -> str:
    """The text with what Microsoft's compilers write for NaN and infinities (``-1.#IND``) as
    nan."""
    return _LOST.sub("nan", text) if "#" in text else text


def is_header(line: str) -> bool:
    """Whether a line of a file with poses is a comment, or begins with a word."""
    text = line.lstrip("\ufeff \t")
    return text.startswith(("#", "%")) or text[:1].isalpha()


def check_direction(line: str, path: Path) -> None:
    """Raise ``SequenceError`` for a comment or header that says that poses are not camera-to-world
    with OpenCV's axes."""
    if not is_header(line):
        return
    if _OF_COLMAP.search(line):
        raise SequenceError(
            f"{path} is the list of images of a COLMAP model, whose poses are world-to-camera and "
            "have no unit; expected camera-to-world poses in metres: gsfusion-nb convert the "
            "folder of the model"
        )
    if _OTHER_AXES.search(line) and not _OPENCV.search(line):
        raise SequenceError(
            f"{path}: {shown(line.strip())} says that its poses have other axes than OpenCV's "
            "(right, down, forward); turn them, or remove that line and map with "
            "--data.repair.axes, which gsfusion-nb check finds"
        )
    if _FROM_WORLD.search(line) and not _TO_WORLD.search(line):
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
