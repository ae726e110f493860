"""A key of everything that determines the result of a run, so that results of another run are never used for it."""

import functools
import hashlib
import importlib.util
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import torch

from .. import __version__
from ..files import file_hashes

_CODE = {".py", ".cu", ".cuh"}
LIBRARIES = {"torch": torch.__version__, "numba": numba.__version__, "numpy": np.__version__, "opencv": cv2.__version__}
"""The libraries that compute the numbers of a run, and their versions."""


def run_key(**parts: Any) -> str:
    """A key of ``parts`` (plain values), of this package's version and source, and of ``LIBRARIES``: 32 hexadecimal
    digits.

    Two runs with the same key give the same map on one machine. A change in the data, the settings, a rule, an option,
    the seed, the program or its libraries gives another key.
    """
    parts |= {"version": __version__, "package": package_fingerprint(), "libraries": LIBRARIES}
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


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
            found += file_hashes([path]).values()
    return found


def _source_folders() -> list[Path]:
    package = (__package__ or "").split(".")[0]
    kernels = importlib.util.find_spec(f"{package}.kernels")
    places = kernels.submodule_search_locations if kernels is not None else None
    return [Path(__file__).resolve().parents[1], *(Path(place) for place in places or ())]
