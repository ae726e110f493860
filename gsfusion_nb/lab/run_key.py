"""A key of everything that determines the result of a run, so that results of another run are never used for it."""

import functools
import hashlib
import importlib.util
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .. import __version__

_ENDS_BYTES = 4096
"""Number of bytes that are read at the beginning and at the end of each file of a recording."""
_CODE = {".py", ".cu", ".cuh"}


def run_key(**parts: Any) -> str:
    """A key of ``parts`` (plain values), the version and the source of this package: 32 hexadecimal digits.

    Two runs with the same key give the same map on one machine. A change in the data, the settings, a rule, an option,
    the seed or the program gives another key.
    """
    parts |= {"version": __version__, "package": package_fingerprint()}
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def folder_fingerprint(path: str | Path) -> str:
    """A hash of the files in a folder: names, sizes, first and last bytes. If it is not a folder, its name in words."""
    root, digest = Path(path).expanduser(), hashlib.blake2b(digest_size=16)
    if not root.is_dir():
        return f"not a folder: {path}"
    for folder, folders, names in os.walk(root):
        folders.sort()
        for name in sorted(names):
            _add_file(digest, Path(folder) / name, (Path(folder) / name).relative_to(root))
    return digest.hexdigest()


@functools.cache
def package_fingerprint() -> str:
    """A hash of the source of this package and its kernels."""
    digest = hashlib.blake2b(digest_size=16)
    for root in _source_folders():
        for file in sorted(p for p in root.rglob("*") if p.suffix in _CODE):
            digest.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def arguments_with_files(arguments: Iterable[str]) -> list[Any]:
    """Arguments of a command; after each one that names a file, a hash of its content is inserted."""
    found: list[Any] = []
    for argument in arguments:
        found.append(argument)
        path = Path(argument.partition("=")[2] or argument)
        if ".py:" in path.name:  # a seeding rule in a file
            path = path.with_name(path.name.partition(":")[0])
        if path.is_file():
            with path.open("rb") as file:
                found.append(hashlib.file_digest(file, "blake2b").hexdigest()[:32])
    return found


def _source_folders() -> list[Path]:
    package = (__package__ or "").split(".")[0]
    kernels = importlib.util.find_spec(f"{package}.kernels")
    places = kernels.submodule_search_locations if kernels is not None else None
    return [Path(__file__).resolve().parents[1], *(Path(place) for place in places or ())]


def _add_file(digest: Any, file: Path, name: Path) -> None:
    try:
        if not file.is_file():
            return
        size = file.stat().st_size
        with file.open("rb") as opened:
            digest.update(f"{name}\0{size}\0".encode() + opened.read(_ENDS_BYTES))
            if size > _ENDS_BYTES:
                opened.seek(max(_ENDS_BYTES, size - _ENDS_BYTES))
                digest.update(opened.read(_ENDS_BYTES))
    except OSError:
        digest.update(f"{name}\0unreadable".encode())
