"""Installed distributions: which one a file belongs to, its version, and whether a file of it was
edited since."""

import base64
import contextlib
import functools
import hashlib
import importlib.metadata
import os
import re
import sys
import sysconfig
import time
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

_FOLDERS = {
    Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")
}
_PACKAGES = {"site-packages", "dist-packages"}
_CODE = (".py", ".so", ".pyd", ".dll", ".dylib")


@functools.lru_cache(maxsize=65536)
def is_installed(file: str | Path) -> bool:
    """Whether a file belongs to Python or to an installed package, rather than to somebody's own
    code."""
    path = Path(file)
    return bool(_PACKAGES.intersection(path.parts)) or any(
        path.is_relative_to(folder) for folder in _FOLDERS
    )


@dataclass(frozen=True)
class _Record:
    """The list of files of an installed distribution (RECORD: path, hash and size of each)."""

    path: Path
    text: bytes

    @property
    def root(self) -> Path:
        return self.path.parent.parent

    @property
    def name(self) -> str:
        """Name of the distribution, as other distributions ask for it."""
        return normalised_name(self.path.parent.name.partition("-")[0])

    def has(self, file: Path) -> bool:
        """Whether the distribution installed this file."""
        if not file.is_relative_to(self.root):
            return False
        line = file.relative_to(self.root).as_posix().encode() + b","
        return self.text.startswith(line) or b"\n" + line in self.text


def normalised_name(name: str) -> str:
    """Name of a distribution in one spelling (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


@functools.cache
def _records() -> dict[str, _Record]:
    """Name -> record of every installed distribution that has one; the first on Python's path
    counts."""
    records: dict[str, _Record] = {}
    for folder in dict.fromkeys(sys.path):
        for path in sorted(Path(folder or ".").glob("*.dist-info/RECORD")):
            record = _Record(path, path.read_bytes())
            records.setdefault(record.name, record)
    return records


@functools.lru_cache(maxsize=4096)
def distribution_of(file: Path) -> str:
    """Name of the distribution that installed a file; empty if none did, as for a file that was put
    beside them."""
    return next(
        (name for name, record in _records().items() if record.has(file)),
        "",
    )


def with_requirements(names: Iterable[str]) -> list[str]:
    """Distributions and all that they require, as far as it is installed, sorted."""
    distributions: set[str] = set()
    waiting = [normalised_name(name) for name in names]
    while waiting:
        name = waiting.pop()
        if name not in distributions and name in _records():
            distributions.add(name)
            waiting += _requirements(name)
    return sorted(distributions)


@functools.cache
def _requirements(name: str) -> list[str]:
    """Names that a distribution requires, without those of its extras."""
    requires = importlib.metadata.distribution(name).requires or []
    texts = [text for text in requires if "extra ==" not in text.partition(";")[2]]
    return [normalised_name(re.split(r"[\s\[<>=!~;(]", text, maxsplit=1)[0]) for text in texts]


@functools.cache
def state_of(name: str) -> str:
    """Version of an installed distribution and, if files of it were edited since, a hash of these.

    A process may have loaded a file before it was edited. So where one was edited while the process
    runs, the state is one that no other process has. It is looked up once, and again after
    ``look_again``.
    """
    version = importlib.metadata.version(name)
    edits = _edits(normalised_name(name))
    return f"{version} edited {edits}" if edits else version


def look_again() -> None:
    """Forget the states of distributions: files may have been edited since."""
    state_of.cache_clear()


BEGAN_NS = time.time_ns()
"""When this process began, nearly."""
ONLY_HERE = uuid.uuid4().hex
"""What no other process has."""


def _edits(name: str) -> str:
    """A hash of the code files that are no longer what the distribution installed; empty if there
    are none.

    Only a file that changed after the list of files was written is read: a change sets a file's
    ctime, which no program sets back. One that is gone is always an edit.
    """
    record = _records().get(name)
    if record is None:
        return ""
    digest = hashlib.blake2b(digest_size=16)
    installed_ns = os.stat(record.path).st_ctime_ns
    has_edits = False
    latest_ns = 0
    for line in record.text.decode(errors="surrogateescape").splitlines():
        relative, _, rest = line.strip('"').partition(",")
        recorded_hash = rest.partition(",")[0].partition("=")[2]
        if not relative.endswith(_CODE) or not recorded_hash:
            continue
        path = os.path.join(record.root, relative)
        changed_ns = changed_at(path)
        is_here = os.path.isfile(path)
        if is_here and changed_ns <= installed_ns:
            continue
        content = Path(path).read_bytes() if is_here else b""
        if _as_recorded(content) != recorded_hash:
            has_edits = True
            latest_ns = max(latest_ns, changed_ns)
            digest.update(
                relative.encode(errors="surrogateescape") + b"\0" + hashlib.sha256(content).digest()
            )
    if latest_ns > BEGAN_NS:
        digest.update(ONLY_HERE.encode())
    return digest.hexdigest() if has_edits else ""


def changed_at(path: str | Path) -> int:
    """When a file was changed last, nanoseconds since 1970; of one that is gone, when the folder
    that held it was."""
    for place in (Path(path), *Path(path).parents):
        with contextlib.suppress(OSError):
            return os.stat(place).st_ctime_ns
    return time.time_ns()


def _as_recorded(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
