"""Values of a calibration that say that the images are not as its camera saw them: a part of the
sensor, scaled, turned or mirrored afterwards, or taken from another place."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...checks import shown
from ...errors import SequenceError

_SCALES = re.compile(
    r"(?i)((image|img)_?)?(scale(_?factor)?|resize(_?(factor|scale))?|(down|up)_?scal(e|ing)"
    r"(_?factor)?|(down|sub)_?sampl(e|ing)(_?factor)?|(digital_?)?zoom)"
)
_TURNS = re.compile(
    r"(?i)((image|img|exif)_?)?(rotat(e|ed|ion)(_?(deg|degrees|angle|matrix))?|orientation"
    r"|[hv]?_?flip(ped)?(_?(x|y|h|v|horizontal(ly)?|vertical(ly)?))?|mirror(ed)?|transposed?)"
)
_PLACES = re.compile(r"(?i)translation")

_OF_A_PART = re.compile(r"roi|binning(_[xy])?|[xy]_offset|offset_[xy]|crop_(x|y|left|top)")
"""Names of what makes the images a part of the sensor, or every second pixel of it."""

_DEPTH_UNIT_FROM = 10.0
"""A scale from here on is the stored depth of one metre (``depth_camera``)."""

_NOTHING = ("", "none", "no", "false", "normal", "identity", "landscape")


def check_unchanged(values: Mapping[str, Any], source: str) -> None:
    """Raise ``SequenceError`` where the values of a camera say that its images were changed: a
    scale other than 1, a turn, a mirror, or a place beside another camera."""
    changes = (
        (_SCALES, _is_no_scale, "that images or intrinsics were scaled"),
        (_TURNS, _is_no_turn, "that the images or their camera are turned"),
        (_PLACES, _is_zero, "that the camera stands beside another one"),
    )
    for name, value in values.items():
        for pattern, changes_nothing, meaning in changes:
            if pattern.fullmatch(str(name)) and not changes_nothing(value):
                raise SequenceError(
                    f"{source}: {name} = {shown(value)} may say {meaning}, which is not known "
                    "here; give the intrinsics of the images as they are stored: --intrinsics "
                    "'fx fy cx cy [k1 k2 p1 p2 k3]'"
                )


def check_whole_sensor(values: Mapping[str, Any], size: tuple[int, int], source: str) -> None:
    """Raises ``SequenceError`` where the camera may be that of a larger image than its own."""
    for name, value in values.items():
        if not _OF_A_PART.fullmatch(str(name)):
            continue
        parts = value if isinstance(value, Mapping) else {name: value}
        whole = {"width": size[0], "height": size[1]}
        changes = (
            is_not_zero(part)
            and part != whole.get(part_name)
            and not (str(part_name).startswith("binning") and part == 1)
            for part_name, part in parts.items()
        )
        if any(changes):
            raise SequenceError(
                f"{source}: {name} = {shown(value)} says that the images are a part of the sensor, "
                "and not whether the intrinsics are those of the images; give these as "
                "--intrinsics 'fx fy cx cy [k1 k2 p1 p2 k3]'"
            )


def _is_no_scale(value: Any) -> bool:
    numbers = _numbers(value)
    if numbers is None:
        return _is_nothing(value)
    return bool((numbers == 1).all() or (numbers.size == 1 and numbers[0] >= _DEPTH_UNIT_FROM))


def _is_no_turn(value: Any) -> bool:
    """Whether this is an angle of 0, a matrix or quaternion that does not turn, or EXIF's 1."""
    numbers = _numbers(value)
    if numbers is None:
        return _is_nothing(value)
    no_turns = [np.zeros(n) for n in (1, 3)]
    no_turns += [np.ones(1), np.eye(3).ravel(), np.eye(4)[0], np.eye(4)[3]]
    return any(
        numbers.size == still.size and np.allclose(numbers, still, atol=1e-6) for still in no_turns
    )


def is_no_motion(value: Any) -> bool:
    """Whether a matrix, or a group of a rotation and a translation, moves nothing."""
    if isinstance(value, Mapping) and "data" not in value:
        return all(
            _is_zero(part) if _PLACES.fullmatch(str(name)) else _is_no_turn(part)
            for name, part in value.items()
        )
    numbers = _numbers(value)
    if numbers is None:
        return _is_nothing(value)
    no_motions = [np.eye(4).ravel(), np.eye(4)[:3].ravel()]
    return any(
        numbers.size == still.size and np.allclose(numbers, still, atol=1e-6)
        for still in no_motions
    )


def _is_zero(value: Any) -> bool:
    numbers = _numbers(value)
    return _is_nothing(value) if numbers is None else not numbers.any()


def _is_nothing(value: Any) -> bool:
    return value is None or value is False or str(value).strip().lower() in _NOTHING


def _numbers(value: Any) -> np.ndarray | None:
    """The numbers of a value, also those in a group's ``data``; None where it has none. [N]"""
    if isinstance(value, Mapping):
        value = value.get("data")
    if value is None or isinstance(value, bool):
        return None
    try:
        return np.ravel(np.array(value, dtype=float))
    except (TypeError, ValueError):
        return None


def is_not_zero(value: Any) -> bool:
    """Whether a value is another than 0; text that is no number counts as another."""
    try:
        return bool(np.any(np.array(value, dtype=float) != 0))
    except (TypeError, ValueError):
        return True
