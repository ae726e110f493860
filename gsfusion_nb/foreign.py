"""Reading files of other people and programs: plain files only, within limits, and every error is a sentence.

A file may be damaged, of another kind, or made to harm. So nothing here opens a pipe or a device, which would wait or
never end; nothing takes more memory than the caller allows, also when the content is packed; and whatever a parser of
another project raises becomes a ``SequenceError`` that names the file. All other modules read through this one.

In JSON, what is ambiguous, or no number for a computer, is refused with its place. Python's parser takes the last of
two equal keys, reads NaN and Infinity, which JSON does not have, makes infinities of numbers that are too large, and
ends in a ``RecursionError`` where brackets are nested deeply.
"""

import contextlib
import json
import math
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from .errors import BadFrameError, SequenceError, SequenceNotFoundError

TEXT_BYTES = 256_000_000
"""Of a text file: the poses of a million frames."""
IMAGE_BYTES = 256_000_000
"""Of an encoded image."""
_noted: ContextVar[list[Path] | None] = ContextVar("noted", default=None)


def is_file(path: Path) -> bool:
    """Whether there is a file; False for a name, written by somebody else, that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False


@contextlib.contextmanager
def noting_files() -> Iterator[list[Path]]:
    """A block in which every file that is opened by this module is added to the list that it gives."""
    noted, outer = [], _noted.get()
    token = _noted.set(noted)
    try:
        yield noted
    finally:
        _noted.reset(token)
        if outer is not None:
            outer += noted


def open_regular(path: str | Path, what: str) -> BufferedReader:
    """Open a plain file for reading bytes. Pipes, sockets, devices and folders are refused, before anything waits.

    Raises:
        SequenceNotFoundError: no such file. SequenceError: no plain file, or it may not be read.
    """
    try:
        # A pipe that nobody writes to blocks on opening, unless it is opened without waiting.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise SequenceNotFoundError(f"{path} does not exist; expected {what}") from None
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or e
        if os.path.isdir(path):
            reason = "it is a folder"
        raise SequenceError(f"{path} cannot be read ({reason}); expected {what}") from None
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or device"
        raise SequenceError(f"{path} is {kind}, not a plain file; expected {what}")
    noted = _noted.get()
    if noted is not None:
        noted.append(Path(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> bytes:
    """Content of a plain file (``open_regular``) of at most ``at_most`` bytes."""
    with open_regular(path, what) as file:
        try:
            data = file.read(at_most + 1)
        except OSError as e:
            raise SequenceError(f"{path} cannot be read ({e.strerror}); expected {what}") from None
    if len(data) > at_most:
        raise SequenceError(f"{path} is larger than {at_most / 1e6:g} MB; expected {what}")
    return data


def read_text(path: str | Path, what: str, *, at_most: int = TEXT_BYTES) -> str:
    """Text of a plain file in UTF-8, with or without a byte order mark."""
    try:
        return read_bytes(path, what, at_most=at_most).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SequenceError(f"{path} is not a text file; expected {what}") from None


def read_exactly(file: BinaryIO, n: int, path: str | Path) -> bytes:
    """The next ``n`` bytes of an open file.

    Raises:
        SequenceError: it has fewer; nothing is read then, so a length that is wrong costs no memory.
    """
    left = os.fstat(file.fileno()).st_size - file.tell()
    if not 0 <= n <= left:
        raise SequenceError(f"{path} is truncated: it ends {n - left} bytes too early; copy it again")
    return file.read(n)


def inflate(data: bytes, source: str | Path, *, at_most: int) -> bytes:
    """Unpacked content of a zlib stream. Raises ``BadFrameError`` when it is damaged or larger than ``at_most``."""
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, at_most + 1)
    except zlib.error as e:
        raise BadFrameError(f"{source} cannot be unpacked ({e})") from None
    if len(content) > at_most:
        raise BadFrameError(f"{source} unpacks to more than the {at_most} bytes that were expected")
    if not unpacker.eof:
        raise BadFrameError(f"{source} cannot be unpacked (it is truncated)")
    return content


def open_archive(path: str | Path, what: str) -> zipfile.ZipFile:
    """A zip archive for reading. Raises ``SequenceError`` for another file."""
    open_regular(path, what).close()
    with parsing(path, what):
        return zipfile.ZipFile(path)


def read_member(archive: zipfile.ZipFile, name: str, source: str | Path, *, at_most: int) -> bytes:
    """Content of one member of an archive, of at most ``at_most`` bytes unpacked.

    Raises:
        KeyError: no such member. BadFrameError: it is damaged, encrypted or larger.
    """
    info = archive.getinfo(name)
    if info.file_size > at_most:
        raise BadFrameError(f"{source}: {name} unpacks to {info.file_size} bytes; expected at most {at_most}")
    try:
        with archive.open(info) as member:
            return member.read(at_most)
    except Exception as e:
        raise BadFrameError(f"{source}: {name} is damaged ({reason_of(e)})") from None


@contextlib.contextmanager
def parsing(source: str | Path, what: str, error: type[SequenceError] = SequenceError) -> Iterator[None]:
    """Whatever a parser of another project raises in the block becomes one sentence that names ``source``.

    Such parsers were written for files in order: from a damaged one follows any exception, such as ``struct.error`` or
    ``AssertionError``. Errors that are sentences already pass as they are.
    """
    try:
        yield
    except SequenceError:
        raise
    except MemoryError:
        raise error(f"{source} asks for more memory than there is; it is damaged; expected {what}") from None
    except Exception as e:
        raise error(f"{source} is not readable as {what} ({reason_of(e)}); it may be truncated or damaged") from e


def reason_of(error: Exception) -> str:
    """The kind and the first sentence of an error, short enough to be a part of another sentence."""
    lines = str(error).strip().splitlines()
    text = lines[0].split(". ")[0][:160] if lines else ""
    return text if isinstance(error, OSError | ValueError) and text else f"{type(error).__name__} {text}".strip()


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
