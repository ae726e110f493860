"""JSON of other people and programs: what is ambiguous, or no number for a computer, is refused with its place.

Python's parser takes the last of two equal keys, reads NaN and Infinity, which JSON does not have, makes infinities of
numbers that are too large, and ends in a ``RecursionError`` where brackets are nested deeply.
"""

import json
import math
import re
from pathlib import Path
from typing import Any

from .errors import SequenceError
from .foreign import TEXT_BYTES, read_text

MAX_DEPTH = 64
"""Brackets inside brackets; settings and camera files have about five."""
MAX_DIGITS = 40
"""Of a whole number; a time in nanoseconds has 19."""
MAX_FLOAT_DIGITS = 200
"""Of a number with a point or an exponent; some programs write 60."""

_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{},:]|[^\s\[\]{},:"]+', re.DOTALL)


class _Fault(Exception):
    """The parser met something that is refused; where, is found by ``_first_fault``."""


def read_json(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> Any:
    """Content of a JSON file.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no JSON, or one of the faults above; names the file, the
            line and the column.
    """
    return parse_json(read_text(path, what, at_most=at_most), str(path), what)


def read_object(
    path: str | Path, what: str, *, at_most: int = TEXT_BYTES, objects: tuple[str, ...] = ()
) -> dict[str, Any]:
    """``read_json`` of a file that must hold an object, and in it an object at each of the keys ``objects``."""
    values = read_json(path, what, at_most=at_most)
    if not isinstance(values, dict):
        raise SequenceError(f"{path} must hold a JSON object ({what}), got a {type(values).__name__}")
    for key in objects:
        if not isinstance(values.get(key), dict):
            got = f"a {type(values[key]).__name__}" if key in values else "none"
            raise SequenceError(f"{path} must hold an object at the key {key} ({what}), got {got}")
    return values


def parse_json(text: str, source: str, what: str) -> Any:
    """``read_json`` of text in memory; ``source`` is its name for messages."""
    try:
        if text.count("[") + text.count("{") > MAX_DEPTH and (fault := _first_fault(text, only_depth=True)):
            raise _Fault(fault)
        return json.loads(
            text,
            object_pairs_hook=_object,
            parse_constant=_refuse,
            parse_int=_whole_number,
            parse_float=_number,
        )
    except json.JSONDecodeError as e:
        raise SequenceError(f"{source} is not valid JSON ({e}); expected {what}") from None
    except _Fault as e:
        place = _first_fault(text) or str(e)
        raise SequenceError(f"{source} is not valid JSON ({place}); expected {what}") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        raise _Fault("a key appears twice")
    return values


def _refuse(constant: str) -> Any:
    raise _Fault(f"{constant} is not a number")


def _whole_number(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise _Fault(f"a number of {len(text)} digits")
    return int(text)


def _number(text: str) -> float:
    if len(text) > MAX_FLOAT_DIGITS:
        raise _Fault(f"a number of {len(text)} digits")
    value = float(text)
    if not math.isfinite(value):
        raise _Fault(f"{text[:20]} is too large")
    return value


def _first_fault(text: str, *, only_depth: bool = False) -> str:
    """What is refused first in a JSON text, with line and column; empty if nothing is."""
    keys: list[set[str] | None] = []
    string, string_at = "", 0
    for match in _TOKEN.finditer(text):
        token = match[0]
        if token in ("[", "{"):
            keys.append(set() if token == "{" else None)
            if len(keys) > MAX_DEPTH:
                return f"brackets are nested more than {MAX_DEPTH} deep: {_place(text, match.start())}"
        elif token in ("]", "}"):
            keys = keys[:-1]
        elif only_depth:
            continue
        elif token == ":" and keys and keys[-1] is not None:
            if string in keys[-1]:
                return f"the key {string[:40]} appears twice: {_place(text, string_at)}"
            keys[-1].add(string)
        elif token[0] == '"':
            string, string_at = token, match.start()
        elif token not in (",", "true", "false", "null") and (reason := _bad_number(token)):
            return f"{reason}: {_place(text, match.start())}"
    return ""


def _bad_number(token: str) -> str:
    if token in ("NaN", "Infinity", "-Infinity"):
        return f"{token} is not a JSON number"
    if re.fullmatch(r"-?\d+", token):
        return f"a number of {len(token)} digits" if len(token) > MAX_DIGITS else ""
    if len(token) > MAX_FLOAT_DIGITS and re.fullmatch(r"[-+.eE\d]+", token):
        return f"a number of {len(token)} digits"
    try:
        return "" if math.isfinite(float(token)) else f"{token[:20]} is too large a number"
    except ValueError:
        return ""


def _place(text: str, at: int) -> str:
    return f"line {text.count(chr(10), 0, at) + 1} column {at - (text.rfind(chr(10), 0, at) + 1) + 1}"
