"""JSON that is an object of finite numbers, with a checksum where nobody may change it."""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

from ..errors import ArgumentError, SequenceError
from .atomic import write_file
from .foreign import TEXT_BYTES, read_text


def read_object(
    path: str | Path,
    what: str,
    *,
    at_most: int = TEXT_BYTES,
    objects: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Content of a JSON file that must hold an object, and in it an object at each of the keys
    ``objects``.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no JSON, or refused by ``parse_json``;
            names the file.
    """
    values = parse_json(read_text(path, what, at_most=at_most), str(path), what)
    if not isinstance(values, dict):
        raise SequenceError(
            f"{path} must hold a JSON object ({what}), got a {type(values).__name__}"
        )
    for key in objects:
        if not isinstance(values.get(key), dict):
            got = f"a {type(values[key]).__name__}" if key in values else "none"
            raise SequenceError(f"{path} must hold an object at the key {key} ({what}), got {got}")
    return values


def write_sealed(path: str | Path, values: dict[str, Any]) -> None:
    """Write a JSON object with a checksum of its content, for ``read_sealed``."""
    write_file(
        path,
        json.dumps(values | {_SEAL: _seal_of(values)}, indent=1, allow_nan=False),
    )


def read_sealed(path: str | Path, what: str) -> dict[str, Any]:
    """What ``write_sealed`` wrote, if nobody has changed it since.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no JSON object, or not with the checksum
            of its content.
    """
    values = read_object(path, what)
    seal = values.pop(_SEAL, None)
    if seal is None:
        raise SequenceError(f"{path} is not {what} of this version: it has no checksum")
    if seal != _seal_of(values):
        raise SequenceError(
            f"{path} was changed after it was written: its checksum is not that of its content"
        )
    return values


_SEAL = "checksum"


def _seal_of(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def parse_json(text: str, source: str, what: str) -> Any:
    """Values of a JSON text; ``source`` is its name for messages.

    What is no number for a computer is refused. Python's parser reads NaN and Infinity, which JSON
    does not have, and makes infinities of numbers that are too large. Of two equal keys it takes
    the last one, which is refused here.
    """
    try:
        return json.loads(
            text,
            object_pairs_hook=_object,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_whole,
        )
    except (
        ValueError,
        RecursionError,
    ) as e:  # a ValueError also where a number has thousands of digits
        raise SequenceError(f"{source} is not valid JSON ({e}); expected {what}") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ArgumentError(
            f"the key {next(k for k in keys if keys.count(k) > 1)[:40]!r} appears twice in an "
            "object"
        )
    return values


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ArgumentError(f"{text[:40]} is not a finite number")
    return float(text)
