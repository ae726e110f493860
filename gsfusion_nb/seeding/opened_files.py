"""Files that a seeding rule opens while it runs: in a comparison, those that it does not declare are refused."""

import contextlib
import os
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ..files import cache_folder
from .fingerprint import is_installed

_OWN = __name__.partition(".")[0]
_SYSTEM = tuple(
    Path(place).resolve() for place in ("/dev", "/proc", "/sys", "/etc", "/usr", sys.prefix, sys.base_prefix)
)
_COMPILED = {".nbi", ".nbc"}
_PYTHON = {".py", ".pyc"}


class UndeclaredFileError(ValueError):
    """A seeding rule opened a file that none of its options names."""

    def __init__(self, rule: str, path: Path):
        super().__init__(
            f"the seeding rule {rule!r} reads {path}, which none of its options names, so a comparison would keep its "
            f'old results when the file changes; declare it: weights: Path = Path("{path}")'
        )


class DeclaredFiles:
    """What a rule may open: files that it declares, Python's and those of installed packages, and compiled code.

    Only files are noticed that Python opens, in the thread of the rule: ``open``, ``torch.load``, ``numpy.load``. Files
    opened by compiled code (``cv2.imread``, ``torch.jit.load``) are not.

    Args:
        rule: Name of the rule.
        paths: Files and folders that it declares.
    """

    def __init__(self, rule: str, paths: Iterable[Path]):
        self._rule = rule
        own: list[Any] = [sys.modules[name] for name in (_OWN, f"{_OWN}.kernels") if name in sys.modules]
        packages = [Path(place).resolve() for package in own for place in package.__path__]  # may be links
        self._folders = (*_SYSTEM, *packages, cache_folder(), *(path.expanduser().resolve() for path in paths))
        loaded = [
            getattr(module, name, None) for module in list(sys.modules.values()) for name in ("__file__", "__cached__")
        ]
        self._modules = {file for file in loaded if isinstance(file, str)}
        self._refused: UndeclaredFileError | None = None

    @contextlib.contextmanager
    def only(self) -> Iterator[None]:
        """Context around a call of the rule.

        Raises:
            UndeclaredFileError: it opens another file, also if it catches that error itself.
        """
        _install()
        before, _now.files, self._refused = getattr(_now, "files", None), self, None
        try:
            yield
        finally:
            _now.files = before
        if self._refused is not None:
            raise self._refused

    def check(self, given: str | bytes | os.PathLike, flags: int) -> None:
        """Raise ``UndeclaredFileError`` for a file that may not be opened; one that is made anew may be."""
        writes = flags & (os.O_WRONLY | os.O_TRUNC | os.O_EXCL)
        path = Path(os.path.abspath(os.fsdecode(given)))
        known = path.suffix in _COMPILED or (path.suffix in _PYTHON and str(path) in self._modules)
        if writes or known or is_installed(path):
            return
        path = path.resolve()
        if path.is_file() and not any(path.is_relative_to(folder) for folder in self._folders):
            self._refused = UndeclaredFileError(self._rule, path)
            raise self._refused


_now = threading.local()
_installed = threading.Event()


def _install() -> None:
    if not _installed.is_set():
        _installed.set()
        # A lambda, which no tool that checks types wraps: a wrapper raises events itself, and they would never end.
        sys.addaudithook(lambda event, arguments: _check_open(*arguments) if event == "open" else None)


def _check_open(file: Any, _mode: Any, flags: int) -> None:
    files: DeclaredFiles | None = getattr(_now, "files", None)
    if files is not None and not isinstance(file, int):
        files.check(file, flags)
