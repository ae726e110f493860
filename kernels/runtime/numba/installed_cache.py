"""Compiled kernels beside their sources, which whoever installed the package has compiled: every
other user of the machine reads them.

numba looks beside the sources only for a user who may write there, so each other one would compile
all kernels again. Machine code is read from a folder only if whoever can
write into it can change the sources, too: it belongs to the owner of the source, and nobody else
may write.
"""

import os
from pathlib import Path

from numba.core import caching
from numba.core.caching import CompileResultCacheImpl, FunctionCache

_InTree = getattr(caching, "InTreeCacheLocator", None) or caching._InTreeCacheLocator  # pyright: ignore[reportAttributeAccessIssue]


class InstalledLocator(_InTree):
    """The folder beside a source, for a user who may read it only."""

    def ensure_cache_path(self) -> None:
        """It is there, and nothing is written."""

    @classmethod
    def from_function(cls, py_func, py_file):
        """The locator of a function, or None if what is beside its source is not to be read."""
        locator = cls(py_func, py_file)
        is_used = is_installed(Path(locator.get_cache_path()), Path(py_file))
        return locator if is_used else None


class _InstalledImpl(CompileResultCacheImpl):
    _locator_classes = (InstalledLocator,)


class InstalledCache(FunctionCache):
    """What is kept of one function beside its source. It is never written."""

    _impl_class = _InstalledImpl

    def load_overload(self, sig, target_context):
        """What is kept for these types, or None."""
        try:
            return super().load_overload(sig, target_context)
        except (ImportError, AttributeError, OSError):
            return None

    def save_overload(self, sig, data) -> None:
        """Nothing is kept."""

    def flush(self) -> None:
        """Nothing is removed."""


def installed_cache(function) -> InstalledCache | None:
    """The cache beside the source of a function; None where there is none that may be read."""
    try:
        return InstalledCache(function)
    except RuntimeError:
        return None


def is_installed(folder: Path, source: Path) -> bool:
    """Whether compiled functions in a folder were put there by the owner of their source, and only
    by that one.

    A user who may write there uses it as numba does.
    """
    if not hasattr(os, "getuid"):
        return False
    try:
        status = folder.stat()
        owner = source.stat().st_uid
    except OSError:
        return False
    is_closed = not status.st_mode & 0o022
    return is_closed and status.st_uid == owner and not os.access(folder, os.W_OK)
