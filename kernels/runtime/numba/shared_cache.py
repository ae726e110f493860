"""Numba's cache on disk, shared by several processes: one compiles a function, the others wait and
read what it saved.

Without it two processes would compile the same function side by side, and when they compile it for
different types at the same time, its index could lose one of the two, or name the other's machine
code: numba chooses the name of a data file before it writes it. So a process that does not find a
function in the cache holds a lock beside the function's index until it has saved it.

A function is compiled again when its file has changed, as in numba, and also when a file has that
it imports: numbers and functions of other files are compiled into it.
"""

import ast
import contextlib
import functools
import os
import sys
import time
from importlib.util import resolve_name
from pathlib import Path

from numba.core import dispatcher
from numba.core.caching import FunctionCache, NullCache

from gsfusion_nb.compile_clock import COMPILE_CLOCK
from gsfusion_nb.files import try_lock

from .installed_cache import installed_cache

_KERNELS = __name__.split(".runtime.")[0]
_TOOLKIT = _KERNELS.split(".")[0]

WAIT_S = 120.0
"""A process that holds a lock longer than this has probably been stopped: the function is then
compiled here, too."""
_POLL_S = 0.02

_HELD: dict[Path, list[int]] = {}
"""Lock file -> open handles, the first of which has the lock; the others stand for nested calls of
this process."""


@functools.cache
def imported_files(module: str) -> tuple[Path, ...]:
    """The files of a module of kernels, of all kernels that it imports, and of what these import
    from plain modules."""
    files = set()
    todo = [module]
    while todo:
        name = todo.pop()
        path = Path(getattr(sys.modules.get(name), "__file__", None) or "")
        if not name.startswith(_TOOLKIT) or path.suffix != ".py" or path in files:
            continue
        files.add(path)
        if name.startswith(_KERNELS):
            for line in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(line, ast.ImportFrom):
                    dots = "." * line.level + (line.module or "")
                    todo.append(resolve_name(dots, sys.modules[name].__package__))
    return tuple(sorted(files))


def newest(files: tuple[Path, ...]) -> float:
    """When the last of some files was changed, seconds."""
    return max((path.stat().st_mtime for path in files), default=0.0)


def note_imports(cache: FunctionCache) -> None:
    """What a cache holds of a kernel counts only as long as all files are as old that it
    imports."""
    module = cache._py_func.__module__
    if module.startswith(_KERNELS):
        stamp = cache._impl.locator.get_source_stamp()
        cache._cache_file._source_stamp = (*stamp, newest(imported_files(module)))


class SharedCache(FunctionCache):
    """The cache of one function: what its user may write, and what was installed with the
    package."""

    def __init__(self, py_func):
        super().__init__(py_func)
        self._installed = installed_cache(py_func)

    def load_overload(self, sig, target_context):
        """What is in the cache, or None, and then the lock is held until ``save_overload`` or
        ``release``."""
        if self._installed is not None:
            note_imports(self._installed)
            overload = self._installed.load_overload(sig, target_context)
            if overload is not None:
                return overload
        note_imports(self)
        overload = self._saved(sig, target_context)
        if overload is None and self._py_func.__module__.startswith(_KERNELS):
            self._hold()
            overload = self._saved(sig, target_context)
            if overload is not None:
                self.release()
        return overload

    def _saved(self, sig, target_context):
        """What is in the cache, or None; an index that names types of a module that is gone is
        emptied."""
        try:
            return super().load_overload(sig, target_context)
        except (ImportError, AttributeError):
            self.flush()
            return None

    def save_overload(self, sig, data):
        """Keep what was compiled and let others read it."""
        try:
            super().save_overload(sig, data)
        finally:
            self.release()

    def release(self) -> None:
        """Let go of the lock."""
        handles = _HELD.get(self._lock)
        if handles:
            os.close(handles.pop())

    def _hold(self) -> None:
        handles = _HELD.setdefault(self._lock, [])
        # a folder that cannot be written to keeps no functions either
        with contextlib.suppress(OSError):
            self._impl.locator.ensure_cache_path()
            handles.append(os.open(self._lock, os.O_RDWR | os.O_CREAT, 0o644))
            until = time.monotonic() + WAIT_S
            with COMPILE_CLOCK.compiling():  # by another process
                while len(handles) == 1 and not try_lock(handles[0]) and time.monotonic() < until:
                    time.sleep(_POLL_S)

    @property
    def _lock(self) -> Path:
        return Path(self._cache_path, f"{self._impl.filename_base}.lock")


def has_saved(function) -> bool:
    """Whether a compiled function is on disk, for some types, and as new as its source."""
    cache = getattr(function, "_cache", None)
    caches = [cache, getattr(cache, "_installed", None)]
    for each in caches:
        if isinstance(each, FunctionCache):
            note_imports(each)
            if each._cache_file._load_index():
                return True
    return False


def cache_of(function):
    """The cache of a function, which keeps nothing where no folder can be written."""
    try:
        return SharedCache(function)
    except RuntimeError:
        return installed_cache(function) or NullCache()


dispatcher.FunctionCache = cache_of  # of @njit(cache=True), from here on # pyright: ignore[reportAttributeAccessIssue]
