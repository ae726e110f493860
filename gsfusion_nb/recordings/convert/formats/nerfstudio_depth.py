"""What a ``transforms.json`` says of its depth: its unit, and whether it is measured along the
camera's axis or along the ray of each pixel."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ....checks import shown
from ....data.recorded.files import number
from ....errors import SequenceError

_UNITS = ("depth_unit_scale_factor", "integer_depth_scale", "depth_scale")
"""Metres for each unit of the stored depth: names of nerfstudio, of instant-ngp and NeRFCapture,
and of others."""

_MILLIMETRES = 1e-3
"""Nerfstudio's unit where none is given, in metres."""

_LEAST_PER_METRE = 10.0
"""A ``depth_scale`` from here on is the stored depth of one metre, since no unit of depth is as
long."""

_TYPE = "depth_type"
_IS_ALONG_RAY = "is_euclidean_depth"

_ALONG_AXIS = ("z", "zdepth", "planar", "plane")

_ALONG_RAY = ("ray", "raydepth", "raydistance", "alongray", "euclidean", "distance", "radial")

_CHANGES_DEPTH = re.compile(
    r"(?i).*depth.*(scale|unit|factor|type|kind|shift|offset|bias|inver|dispar|encod|conven"
    r"|projec|euclid|ray|normali|min|max|near|far|range|bound|clip|bits|log|power|gamma|format"
    r"|intrins|extrins|camera|matrix|_to_|fov|_fl_|_c[xy]|_[wh]$|width|height|transform).*"
    r"|.*(inver\w*|dispar\w*|scale|unit|euclidean|normali\w*|min|max|near|far|log|relative)_depth"
)
"""Names that may say what a stored depth means."""

_NAMES_FILE = re.compile(r"(?i).*(path|file|dir|folder|name)s?")


@dataclass(frozen=True)
class DepthMeaning:
    """What the stored depth of a frame means."""

    per_metre: float
    """Stored value of one metre."""
    along_ray: bool
    """It is the distance from the camera's centre, not z-depth."""


def meaning_of_depth(values: Mapping[str, Any], file: Path) -> DepthMeaning:
    """What the stored depth of a frame means.

    Args:
        values: Of the frame, and of the whole file where the frame has none.
        file: For messages.

    Raises:
        SequenceError: two units, a ``depth_type`` that is not known, or another key that may change
            the meaning of depth.
    """
    known = (*_UNITS, _TYPE, _IS_ALONG_RAY)
    unknown = [
        name
        for name, value in values.items()
        if value and name not in known and _is_about_depth(name)
    ]
    if unknown:
        raise SequenceError(
            f"{file}: {unknown[0]} = {shown(values[unknown[0]])} may change what the stored depth "
            f"means, and is not known here; known: {', '.join(known)}; write depth as these say, "
            "or remove the key if it changes nothing"
        )
    return DepthMeaning(_per_metre(values, file), _is_along_ray(values, file))


def _is_about_depth(name: str) -> bool:
    """Whether the name of a value may say what a stored depth means."""
    return bool(_CHANGES_DEPTH.fullmatch(name)) and not _NAMES_FILE.fullmatch(name)


def note_on_depth(scales: Sequence[float], *, along_ray: bool) -> str:
    """A sentence on how depth was read, from the stored values of one metre of all frames."""
    least = min(scales)
    most = max(scales)
    extent = f"{least:g}" if least == most else f"{least:g} to {most:g}"
    if along_ray:
        return f"depth read as {extent} per metre along the ray, and turned into z-depth"
    return f"depth read as {extent} per metre"


def _per_metre(values: Mapping[str, Any], file: Path) -> float:
    scales = {}
    for name in _UNITS:
        if name not in values:
            continue
        unit = number(dict(values), name, _MILLIMETRES, file)
        if unit <= 0:
            raise SequenceError(f"{file}: {name} must be > 0, got {shown(values[name])}")
        is_per_metre = name == "depth_scale" and unit >= _LEAST_PER_METRE
        scales[name] = unit if is_per_metre else 1 / unit
    if not scales:
        return 1 / _MILLIMETRES
    first = next(iter(scales.values()))
    if any(abs(scale / first - 1) > 1e-6 for scale in scales.values()):
        scales_text = ", ".join(f"{name} {scale:g}" for name, scale in scales.items())
        raise SequenceError(
            f"{file} names several units of depth, {scales_text} per metre; expected one"
        )
    return first


def _is_along_ray(values: Mapping[str, Any], file: Path) -> bool:
    kind = values.get(_TYPE)
    is_ray = values.get(_IS_ALONG_RAY)
    if is_ray is not None and not isinstance(is_ray, bool):
        raise SequenceError(f"{file}: {_IS_ALONG_RAY} must be true or false, got {shown(is_ray)}")
    if kind is None:
        return bool(is_ray)
    word = re.sub(r"[\s_-]", "", kind).lower() if isinstance(kind, str) else ""
    if word not in (*_ALONG_AXIS, *_ALONG_RAY):
        raise SequenceError(
            f"{file}: {_TYPE} = {shown(kind)} is not known; expected z, the depth along the "
            "camera's axis, or ray, the distance from its centre, both in the unit that "
            f"{_UNITS[0]} gives"
        )
    along_ray = word in _ALONG_RAY
    if is_ray is not None and is_ray != along_ray:
        raise SequenceError(f"{file}: {_TYPE} and {_IS_ALONG_RAY} contradict each other")
    return along_ray
