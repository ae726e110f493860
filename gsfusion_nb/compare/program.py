"""The program that computes a run: this package, the libraries, and what was changed in them; and
keys made of it."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import __version__
from ..code_keys import code_key, installed
from ..code_keys.patches import changed_values, library_state, patches, switches
from ..mapping import Mapper
from ..mapping.systems import system_key
from ..seeding import SeedingRule, is_built_in, rule_files

_CODE = {".py", ".toml", ".cu", ".cuh"}
_LIBRARIES = {
    "torch": "torch",
    "numba": "numba",
    "numpy": "numpy",
    "opencv": "opencv-python-headless",
    "scipy": "scipy",
    "kornia": "kornia",
}
_WATCHED = (
    "gsfusion_nb.",
    "torch._tensor.Tensor.",
    "torch.nn.functional.",
    "numpy.linalg.",
    "math.",
)
_at_start = library_state(*_WATCHED)
"""The package and the most used names of libraries, as they were when this module was imported."""


@functools.cache
def libraries() -> dict[str, str]:
    """The libraries that compute the numbers of a run, and their versions."""
    import cv2
    import numba
    import numpy as np
    import torch

    versions = {
        "torch": torch.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }
    versions |= {name: importlib.metadata.version(name) for name in ("scipy", "kornia")}
    return versions | {"python": platform.python_version()}


@functools.cache
def program_in_words() -> str:
    """Version of this package, and the commit of its repository where it is used from one."""
    words = f"gsfusion_nb {__version__}"
    folder = Path(__file__).parents[2]
    if not (folder / ".git").exists():
        return words
    commit = _git(folder, "rev-parse", "--short=10", "HEAD")
    if not commit:
        return words
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{words}, commit {commit}{' with changes' if changed else ''}"


def _git(folder: Path, *words: str) -> str:
    """What git says about a repository; empty if it cannot be asked."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


@functools.cache
def _state_of_process() -> dict[str, dict[str, str]]:
    """Files of libraries that were edited, their functions that were replaced, and switches of
    torch."""
    edits = {}
    for name in _LIBRARIES.values():
        try:
            state = installed.state_of(name)
        except importlib.metadata.PackageNotFoundError:  # another distribution brings the module
            continue
        if " edited " in state:
            edits[name] = state
    return {
        "edited": edits,
        "patches": patches(),
        "swapped": changed_values(_at_start),
        "switches": switches(),
    }


def look_at_program_again() -> None:
    """Forget what was found of the libraries; they may have been changed since."""
    installed.look_again()
    _state_of_process.cache_clear()


def run_key(**parts: Any) -> str:
    """A key of ``parts`` (plain values) and of ``program_parts``: 32 hexadecimal digits.

    Two runs with the same key give the same map on one machine. A change in the data, the settings,
    a rule, an option, the seed, the program or its libraries gives another key. So does a function
    of a library that was replaced.
    """
    text = json.dumps(parts | {"program": program_parts()}, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def program_parts() -> dict[str, str]:
    """What computes a run in this process: each part in words -> its version, a hash or a value.

    The parts are this package and its sources, the libraries, their files that were edited and
    their functions that were replaced, and the switches of torch.
    """
    state = _state_of_process()
    return (
        {"the version of gsfusion_nb": __version__}
        | {"the sources of gsfusion_nb": package_fingerprint()}
        | {f"the version of {name}": version for name, version in libraries().items()}
        | {f"the files of {name}": files for name, files in state["edited"].items()}
        | {f"{name}, replaced": digest for name, digest in state["patches"].items()}
        | {f"{name}, changed": digest for name, digest in state["swapped"].items()}
        | {f"torch's or numpy's {name}": value for name, value in state["switches"].items()}
    )


def differing_parts(there: Mapping[str, str]) -> list[str]:
    """The parts of the program that another process has otherwise than this one, sorted.

    Args:
        there: Its ``program_parts``.
    """
    here = program_parts()
    return sorted(name for name in here.keys() | there if here.get(name) != there.get(name))


@functools.cache
def package_fingerprint() -> str:
    """A hash of the source of this package and its kernels, but not of JupyterLab's copies of
    opened files.

    A process may have loaded a file before it was edited. So if one was edited while the process
    runs, no other process has this hash.
    """
    digest = hashlib.blake2b(digest_size=16)
    edited_later = False
    for root in _source_folders():
        for file in sorted(
            p
            for p in root.rglob("*")
            if p.suffix in _CODE and p.parent.name != ".ipynb_checkpoints"
        ):
            digest.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes())
            edited_later = edited_later or installed.changed_at(file) > installed.BEGAN_NS
    if edited_later:
        digest.update(installed.ONLY_HERE.encode())
    return digest.hexdigest()


def _source_folders() -> list[Path]:
    package = (__package__ or "").split(".")[0]
    kernels = importlib.util.find_spec(f"{package}.kernels")
    places = kernels.submodule_search_locations if kernels is not None else None
    return [Path(__file__).resolve().parents[1], *(Path(place) for place in places or ())]


def own_code(
    rule: SeedingRule,
    options: Mapping[str, Any],
    mapper: type[Mapper],
) -> dict[str, Any]:
    """The fields ``code`` and ``not_kept`` of a run: what its rule and its system are made of, if
    they are not this package's, and the files that options of the rule name.

    Raises:
        FileNotFoundError: an option names a file that does not exist.
    """
    parts: dict[str, str] = {}
    not_kept = ""
    if not is_built_in(rule):
        key = code_key(rule)
        parts |= key.parts
        not_kept = key.reason
        parts |= {f"option {name}": digest for name, digest in rule_files(rule, options).items()}
    if not is_built_in(mapper):
        key = system_key(mapper)
        parts |= {f"system: {name}": digest for name, digest in key.parts.items()}
        not_kept = not_kept or key.reason
    return {"code": parts, "not_kept": not_kept}
