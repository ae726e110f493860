"""The key of code: everything that decides what a rule, or another function or class, does. Equal
keys, equal work.

It is made here and nowhere else, for the lab, for ``--resume``, and again by every process before
it works.
"""

import ast
import functools
import hashlib
import importlib.machinery
import json
import sys
import types
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..extensions import extensions
from .digest import UnhashableError
from .installed import distribution_of, is_installed, state_of, with_requirements
from .origin import BESIDE, LOADED_SOURCE, RULE_SOURCE, is_library_module
from .programs import NOT_OF_A_PROGRAM
from .values import ValueHash

_PACKAGE = __name__.partition(".")[0]
_LOOKUPS = {"globals", "vars", "eval", "exec", "locals", "getattr", "__import__"}


@dataclass(frozen=True, kw_only=True)
class CodeKey:
    """What decides what some code does."""

    parts: Mapping[str, str]
    """Part -> its hash or version. "values": code and values as they are loaded here, by what the
    code can reach. "file NAME": content of a module's file, of all modules that are imported and
    are no installed packages. "package NAME": version of an installed distribution, with a hash of
    its files that were edited since. "missing NAME": a module that is imported and is not there."""
    reason: str = ""
    """Why the key says too little, so that nothing can be reused by it; empty if it says all."""
    files: tuple[Path, ...] = field(default=(), repr=False, compare=False)
    """The files of own modules."""
    caches: tuple[Any, ...] = field(default=(), repr=False, compare=False)
    """Functions with ``functools.cache`` that the code can reach."""
    walks_sets: bool = field(default=False, repr=False, compare=False)
    """The code has a set, or makes one, whose order may differ from process to process."""

    @functools.cached_property
    def digest(self) -> str:
        """All parts in one hash, 32 hexadecimal digits."""
        text = json.dumps([dict(self.parts), self.reason], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def code_key(code: Any) -> CodeKey:
    """The key of a function or class: its code and values, the files of all modules that they come
    from or that these import, and the installed distributions that are reached.

    Own code is what is not installed. It is hashed twice, as a file and as it is loaded: a process
    in which an older version of a file is loaded has another key. Of packages in site-packages the
    version counts, and an edited file.
    """
    values = ValueHash()
    parts: dict[str, str] = {}
    reason = ""
    try:
        values.add(code, getattr(code, "__name__", type(code).__name__))
        parts["values"] = values.hexdigest()
    except UnhashableError as e:
        reason = str(e)
    files = _Closure(values.modules.values(), _modules_by_rule_name(values.words))
    parts |= files.parts
    for name, module in sorted(files.whole.items()):
        loose = ValueHash(strict=False)
        loose.add({k: v for k, v in sorted(vars(module).items()) if k not in NOT_OF_A_PROGRAM})
        parts[f"names in {name}"] = loose.hexdigest()
    parts |= _packages(values.libraries | files.libraries)
    return CodeKey(
        parts=parts,
        reason=reason or files.reason,
        files=tuple(files.files),
        caches=tuple(values.caches),
        walks_sets=values.walks_sets,
    )


def _modules_by_rule_name(words: Container[str]) -> list[str]:
    """Modules of installed packages whose seeding rules code asks for by their names, if these are
    among its ``words``."""
    if "get_rule" not in words:
        return []
    return [rule.entry.module for name, rule in extensions("rules").items() if name in words]


def loaded_values(code: Any) -> str:
    """A hash of the code and values as they are now, without any file; why there is none where it
    cannot be made."""
    values = ValueHash()
    try:
        values.add(code, getattr(code, "__name__", type(code).__name__))
    except UnhashableError as e:
        return str(e)
    return values.hexdigest()


def rule_fingerprint(code: Any) -> str:
    """``code_key(code).digest``."""
    return code_key(code).digest


def differing(a: Mapping[str, str], b: Mapping[str, str]) -> str:
    """The parts in which two keys differ, in words."""
    names = [name for name in sorted({*a, *b}) if a.get(name) != b.get(name)]
    words = [
        f"{name} ({a[name]}, {b[name]})" if _is_version(name, a, b) else name for name in names
    ]
    return ", ".join("code or values as loaded" if word == "values" else word for word in words)


def _is_version(
    name: str,
    a: Mapping[str, str],
    b: Mapping[str, str],
) -> bool:
    return name.startswith("package ") and name in a and name in b


def _packages(modules: Iterable[str]) -> dict[str, str]:
    """State of the distributions that modules of libraries belong to, and of all that they
    require."""
    names = set()
    for module in modules:
        top = module.partition(".")[0]
        if top == _PACKAGE or top in sys.stdlib_module_names:
            continue
        file = (
            _file_of(sys.modules.get(module))
            or _file_of(sys.modules.get(top))
            or _origin(where_module(top, None))  # of one that is not loaded
        )
        if file is not None and (name := distribution_of(file)):
            names.add(name)
    return {
        f"package {name}": state_of(name)
        for name in with_requirements(names)
        if name != "gsfusion-nb"
    }


def _file_of(module: types.ModuleType | None) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file) if file else None


class _Closure:
    """The files of own modules, and of all own modules that they import, at any depth of their
    code.

    Args:
        modules: Modules to begin with, as they are loaded.
        names: Names of further modules.
    """

    def __init__(self, modules: Iterable[types.ModuleType], names: Iterable[str] = ()):
        self.parts: dict[str, str] = {}
        self.libraries: set[str] = set()
        self.files: list[Path] = []
        self.reason = ""
        self.whole: dict[str, types.ModuleType] = {}
        """Modules whose names may be looked up while the code runs, all of them if any module does
        so."""
        self._visited_names: set[str] = set()
        self._modules: dict[str, types.ModuleType] = {}
        self._looks_up = False
        for module in sorted(modules, key=lambda module: module.__name__):
            self._add_module(module)
        for name in sorted(names):
            self._add_import(name, None)
        if self._looks_up:
            self.whole = dict(self._modules)

    def _add_module(self, module: types.ModuleType) -> None:
        if module.__name__ == "__main__" or id(module) in map(id, self._modules.values()):
            return
        name = "of the rule" if hasattr(module, RULE_SOURCE) else module.__name__
        self._modules[name] = module
        source = getattr(module, LOADED_SOURCE, None)
        file = _file_of(module)
        content = source if source is not None else None if file is None else _read(file)
        package = (
            module.__name__ if hasattr(module, "__path__") else module.__name__.rpartition(".")[0]
        )
        self._add_file(name, file, content, package, getattr(module, BESIDE, None))

    def _add_file(
        self,
        name: str,
        file: Path | None,
        content: bytes | None,
        package: str,
        finder: Any,
    ) -> None:
        if name in self._visited_names:
            return
        self._visited_names.add(name)
        if file is not None:
            self.files.append(file)
        if content is None:
            if file is not None:
                self.reason = (
                    self.reason or f"{file}, the file of the module {name}, cannot be read"
                )
            return
        self.parts[f"file {name}"] = hashlib.blake2b(content, digest_size=16).hexdigest()
        if file is not None and file.suffix in importlib.machinery.EXTENSION_SUFFIXES:
            return
        tree = _syntax_tree(content)
        self._look_at_lookups(tree, name)
        for module_name in sorted(set(_imports(tree, package))):
            self._add_import(module_name, finder)

    def _look_at_lookups(self, tree: ast.AST, name: str) -> None:
        """Note what the calls in ``tree`` look up while the program runs: modules by a name that is
        made then, which is a reason to keep no result, and attributes."""
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            function_name = (
                call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
            )
            constant = [isinstance(a, ast.Constant) for a in call.args]
            if function_name in (
                "import_module",
                "__import__",
                "run_path",
                "run_module",
            ) and not all(constant[:1]):
                self.reason = self.reason or (
                    f"{name}, line {call.lineno}, imports a module whose name is made while it "
                    f"runs ({function_name})"
                )
            if isinstance(call.func, ast.Name) and function_name in _LOOKUPS:
                self._looks_up = (
                    self._looks_up or function_name != "getattr" or not all(constant[1:2])
                )

    def _add_import(self, name: str, finder: Any) -> None:
        """Add a module by its name, and the packages that it is in."""
        parts = name.split(".")
        if parts[0] == _PACKAGE or parts[0] in sys.stdlib_module_names:
            return
        for n in range(1, len(parts) + 1):
            full_name = ".".join(parts[:n])
            module = finder.modules.get(full_name) if finder is not None else None
            if module is None and not (finder is not None and finder.has(full_name)):
                module = sys.modules.get(full_name)
            if isinstance(module, types.ModuleType) and not is_library_module(module):
                self._add_module(module)
                continue
            spec = where_module(full_name, finder)
            if spec is None:
                if n == 1:
                    self.parts[f"missing {full_name}"] = ""
                return
            file = _origin(spec)
            is_beside = finder is not None and finder.has(full_name)
            if file is not None and is_installed(file) and not is_beside and distribution_of(file):
                self.libraries.add(full_name)
                return
            package = (
                full_name
                if spec.submodule_search_locations is not None
                else full_name.rpartition(".")[0]
            )
            if file is not None:
                self._add_file(full_name, file, _read(file), package, finder)


def imported_names(source: bytes, package: str) -> list[str]:
    """Names of the modules that a source may import, sorted. ``package``: the package that it is
    in."""
    return sorted(set(_imports(_syntax_tree(source), package)))


def _syntax_tree(source: bytes) -> ast.AST:
    try:
        return ast.parse(source)
    except (SyntaxError, ValueError):  # a compiled module, or one that cannot be imported either
        return ast.Module(body=[], type_ignores=[])


def _read(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None


def _origin(spec: importlib.machinery.ModuleSpec | None) -> Path | None:
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def where_module(name: str, finder: Any) -> importlib.machinery.ModuleSpec | None:
    """Where a module is, without importing anything; None if there is none."""
    path: Any = None
    spec = None
    parts = name.split(".")
    for n in range(1, len(parts) + 1):
        full_name = ".".join(parts[:n])
        finders = [*([finder] if finder is not None else []), *sys.meta_path]
        specs = (
            place.find_spec(full_name, path) for place in finders if hasattr(place, "find_spec")
        )
        try:
            spec = next((spec for spec in specs if spec is not None), None)
        except (ImportError, ValueError, AttributeError):
            spec = None
        if spec is None:
            return None
        path = spec.submodule_search_locations
        if path is None and n < len(parts):
            return None
    return spec


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    """Names of the modules that a file may import; ``from a import b`` may import a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = (
                ".".join(package.split(".")[: len(package.split(".")) - node.level + 1])
                if node.level
                else ""
            )
            source = ".".join(filter(None, (base, node.module)))
            if source:
                yield source
                yield from (f"{source}.{alias.name}" for alias in node.names if alias.name != "*")
        elif isinstance(node, ast.Call) and _function_name(node) in ("import_module", "__import__"):
            first = node.args[0] if node.args else None
            if (
                isinstance(first, ast.Constant)
                and isinstance(first.value, str)
                and not first.value.startswith(".")
            ):
                yield first.value


def _function_name(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
