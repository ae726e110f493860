"""Modules beside a rule's file: its folder is importable for the rule alone, and what runs is what
is on disk now."""

import builtins
import contextlib
import functools
import hashlib
import importlib.machinery
import sys
import threading
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..code_keys.key import imported_names, where_module
from ..code_keys.origin import BESIDE, LOADED_SOURCE, keep_home

_SWAPPING = threading.RLock()
"""While the modules of one rule are in ``sys.modules``, no other thread imports those of
another."""


class Beside:
    """Finds the modules in a folder, for the rule that was loaded from it. Another rule of another
    folder may have modules of the same names.

    A module of Python itself is never taken from the folder. The source is compiled each time,
    since Python's own copies of compiled files miss a change within a second. Without a folder
    nothing is found.
    """

    def __init__(self, folder: Path | None):
        self.folder = folder
        self.modules: dict[str, types.ModuleType] = {}
        """Modules that were imported, by name."""
        self._is_active = False
        self.builtins = {**vars(builtins), "__import__": self._import}
        """For the rule's modules: their import statements look beside the file first, also while
        the rule runs."""

    def has(self, name: str) -> bool:
        """Whether a module, by its dotted name, comes from the folder."""
        top = name.partition(".")[0]
        return self.folder is not None and top not in sys.stdlib_module_names and self._holds(top)

    @functools.cache  # noqa: B019 (a rule's finder lives as long as its modules)
    def _holds(self, top: str) -> bool:
        spec = importlib.machinery.PathFinder.find_spec(top, [str(self.folder)])
        if spec is None or spec.origin is not None:
            return spec is not None
        has_code = any(
            file
            for place in spec.submodule_search_locations or ()
            for file in Path(place).glob("*.py")
        )
        return has_code and importlib.machinery.PathFinder.find_spec(top) is None

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        """As ``sys.meta_path`` asks."""
        if not self.has(name):
            return None
        spec = importlib.machinery.PathFinder.find_spec(
            name, [str(self.folder)] if path is None else path
        )
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _FromSource(name, spec.loader.path, self)
        return spec

    @contextlib.contextmanager
    def importable(self) -> Iterator[None]:
        """Context in which the folder is importable, and its modules are the ones in
        ``sys.modules``."""
        with _SWAPPING:
            if self._is_active:  # a module beside the file imports another one
                yield
                return
            self._is_active = True
            others = {name: module for name, module in list(sys.modules.items()) if self.has(name)}
            for name in others:
                del sys.modules[name]
            sys.modules.update(self.modules)
            sys.meta_path.insert(0, self)
            try:
                yield
            finally:
                sys.meta_path.remove(self)
                for name in [name for name in sys.modules if self.has(name)]:
                    self.modules[name] = sys.modules.pop(name)
                sys.modules.update(others)
                self._is_active = False

    def sources_of(self, source: bytes) -> dict[str, bytes]:
        """Name -> content of the modules in the folder that a source imports, and those that these
        import."""
        return {name: content for name, (_, content) in self._imports_of(source).items()}

    def files_of(self, source: bytes) -> dict[str, bytes]:
        """The same by path, relative to the folder; without packages that have no file of their
        own."""
        assert self.folder is not None
        modules = self._imports_of(source).values()
        return {
            file.relative_to(self.folder).as_posix(): content
            for file, content in modules
            if file != self.folder
        }

    def _imports_of(self, source: bytes) -> dict[str, tuple[Path, bytes]]:
        modules: dict[str, tuple[Path, bytes]] = {}
        waiting = [("", source)]
        while waiting:
            package, importing = waiting.pop()
            for name in imported_names(importing, package):
                for full_name in _with_packages(name):
                    if full_name in modules or not self.has(full_name):
                        continue
                    spec = where_module(full_name, self)
                    if spec is None:
                        break
                    file = Path(spec.origin) if spec.has_location and spec.origin else self.folder
                    assert file is not None
                    content = file.read_bytes() if file != self.folder else b""
                    modules[full_name] = file, content
                    is_package = spec.submodule_search_locations is not None
                    waiting.append(
                        (full_name if is_package else full_name.rpartition(".")[0], content)
                    )
        return modules

    def prepare(self, module: types.ModuleType, source: bytes) -> None:
        """Give a module, before it is executed, what it imports by; and note its source."""
        vars(module)["__builtins__"] = self.builtins
        vars(module)[BESIDE] = self
        vars(module)[LOADED_SOURCE] = source
        keep_home(module)

    def _import(
        self,
        name: str,
        globals: Any = None,
        locals: Any = None,
        fromlist: Any = (),
        level: int = 0,
    ) -> Any:
        if level == 0 and not self.has(name):
            return builtins.__import__(name, globals, locals, fromlist or (), level)
        with self.importable():
            return builtins.__import__(name, globals, locals, fromlist or (), level)


class _FromSource(importlib.machinery.SourceFileLoader):
    """Executes a module from its source."""

    def __init__(self, name: str, path: str, finder: Beside):
        super().__init__(name, path)
        self._finder = finder

    def exec_module(self, module: types.ModuleType) -> None:
        content = self.get_data(self.path)
        self._finder.prepare(module, content)
        exec(compile(content, self.path, "exec", dont_inherit=True), vars(module))


def sources_digest(source: bytes, finder: Beside) -> str:
    """A hash of a rule's file, of the modules that it imports from its folder, and of the name of
    the folder."""
    digest = hashlib.blake2b(source, digest_size=8)
    for name, content in sorted(finder.sources_of(source).items()):
        digest.update(f"\0{name}\0".encode() + content)
    digest.update(str(finder.folder or "").encode())
    return digest.hexdigest()


def _with_packages(name: str) -> list[str]:
    """ "a", "a.b" and "a.b.c" for "a.b.c"."""
    parts = name.split(".")
    return [".".join(parts[: n + 1]) for n in range(len(parts))]
