"""Source code of a seeding rule: rules from files, and hashes of their code, its values, and the files they read."""

import ast
import contextlib
import dataclasses
import dis
import functools
import hashlib
import importlib
import importlib.util
import inspect
import linecache
import os
import sys
import sysconfig
import textwrap
import traceback
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from ..checks import shown
from ..files import UNREADABLE, file_hashes, read_text
from .rule import SeedingRule, get_rule, keep_registered, option_paths, registered, rule_name

_OWN = __name__.partition(".")[0]
_PLAIN = (type(None), bool, int, float, complex, str, bytes)
_INSTALLED = {Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
_PACKAGES = {"site-packages", "dist-packages"}


def is_built_in(rule: SeedingRule) -> bool:
    """The rule is one of this package's, so its name and the package's version say what it does."""
    return (getattr(rule, "__module__", "") or "").startswith(f"{_OWN}.")


def rule_source(rule: SeedingRule) -> str:
    """The source code of a rule, or of its class for a callable object; empty where Python does not know it."""
    target = inspect.unwrap(rule) if inspect.isroutine(rule) else rule if isinstance(rule, type) else type(rule)
    try:
        return textwrap.dedent(inspect.getsource(target))
    except (OSError, TypeError):
        return _source_of_cell(target) if isinstance(target, type) else ""


def _source_of_cell(cls: type) -> str:
    """The source code of a class in a notebook cell, which Python knows by the code of its methods only."""
    methods = [inspect.unwrap(member) for member in vars(cls).values() if inspect.isfunction(member)]
    for code in (method.__code__ for method in methods):
        lines = linecache.getlines(code.co_filename)
        for node in ast.walk(ast.parse("".join(lines))):
            if isinstance(node, ast.ClassDef) and node.name == cls.__name__ and node.end_lineno is not None:
                first = min(part.lineno for part in (node, *node.decorator_list))
                if first <= code.co_firstlineno <= node.end_lineno:
                    return textwrap.dedent("".join(lines[first - 1 : node.end_lineno]))
    return ""


def rule_fingerprint(rule: Any) -> str:
    """A hash of the code of a rule, or of another function, and of the values and functions that the code names.

    It changes when the rule is edited, and when the rule stores something from one call to the next: defaults,
    closure and attributes are hashed, too, and of a class the base classes. Helper modules that are not installed
    packages are followed in the same way, as they are loaded here; of installed packages only names are hashed.
    """
    return read_code(rule).hash.hexdigest()


def read_code(rule: Any) -> "Code":
    """What ``rule_fingerprint`` reads of a rule."""
    code = Code()
    code.add(rule)
    return code


def rule_files(rule: SeedingRule, options: Mapping[str, Any]) -> dict[str, str]:
    """Option name -> hash of the file or folder, for the options of a rule that are paths, defaults included.

    Raises:
        FileNotFoundError: a path that does not exist.
    """
    paths = option_paths(rule, options)
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(
                f"seeding rule {rule_name(rule)!r}: its option {name!r} names {path}, which does not exist here "
                f"(from {Path.cwd()}); expected the file or folder that the rule reads"
            )
    return {name: path_hash(path) for name, path in paths.items()}


def path_hash(path: Path) -> str:
    """A hash of the content of a file, or of all files in a folder with their names, links followed.

    Raises:
        OSError: a file cannot be read.
    """
    digest, files = hashlib.blake2b(digest_size=16), [path]
    if path.is_dir():
        walked = os.walk(path, followlinks=True)
        files = sorted(f for folder, _, names in walked for f in (Path(folder, name) for name in names) if f.is_file())
    hashes = file_hashes(files)
    for file in files:
        if (found := hashes[os.path.abspath(file)]) == UNREADABLE:
            raise OSError(f"{file} cannot be read; expected a file that the seeding rule reads")
        digest.update(f"{file.relative_to(path)}\0{found}\0".encode())
    return digest.hexdigest()


def is_installed(file: str | Path) -> bool:
    """Whether a file belongs to Python or to an installed package, rather than to somebody's own code."""
    path = Path(file)
    return bool(_PACKAGES.intersection(path.parts)) or any(path.is_relative_to(folder) for folder in _INSTALLED)


@functools.lru_cache(maxsize=4096)
def _is_foreign(module: str) -> bool:
    """Whether a module is this package's, Python's or an installed one; of these only names are hashed."""
    if module == "__main__":  # a notebook, or a script
        return False
    if module.partition(".")[0] in (_OWN, *sys.stdlib_module_names) or not module:
        return True
    found = sys.modules.get(module)
    file = getattr(found, "__file__", None)
    if found is None:
        try:
            spec = importlib.util.find_spec(module.partition(".")[0])
        except (ImportError, ValueError):
            return True
        if spec is None:  # made by ``exec``, as a notebook's cells are
            return False
        file = spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    return file is not None and is_installed(file)


class Code:
    """Puts values into a hash, each with its type, each object once."""

    def __init__(self):
        self.hash = hashlib.blake2b(digest_size=16)
        self.caches: list[Any] = []
        """Functions with ``functools.cache`` or ``lru_cache``, such as one that reads a network."""
        self._seen: dict[int, Any] = {}

    def add(self, x: Any) -> None:
        """Any value; of an unknown kind of value only its type."""
        self._text(type(x).__qualname__)
        if isinstance(x, (*_PLAIN, Path)):
            self._text(repr(x))
            return
        if id(x) in self._seen:
            return
        self._seen[id(x)] = x  # kept, so that its id is not given to another
        if hasattr(x, "cache_clear"):
            self.caches.append(x)
        if isinstance(x, types.MethodType):
            self.add(x.__self__)
        x = getattr(x, "__func__", getattr(x, "__wrapped__", x))  # methods, decorated and cached functions
        if isinstance(x, torch.Tensor | np.ndarray):
            self._text(f"{x.dtype} {tuple(x.shape)}")
            if isinstance(x, torch.Tensor):
                x = x.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy()
            self.hash.update(np.ascontiguousarray(x).tobytes())
        elif isinstance(x, Mapping):
            for key in sorted(x, key=repr):
                self.add(key)
                self.add(x[key])
        elif isinstance(x, list | tuple):
            for item in x:
                self.add(item)
        elif isinstance(x, set | frozenset):
            self._text(repr(sorted(map(repr, x))))
        elif isinstance(x, types.FunctionType):
            self._function(x)
        elif isinstance(x, type):
            self._text(f"{x.__module__}.{x.__qualname__}")
            if not _is_foreign(x.__module__):
                self.add(x.__bases__)
                for name, member in sorted(vars(x).items()):
                    if not name.startswith("__") or name in ("__call__", "__init__", "__post_init__"):
                        self.add(member)
        elif isinstance(x, property):
            self.add((x.fget, x.fset))
        elif isinstance(x, functools.partial):
            self.add((x.func, x.args, x.keywords))
        elif isinstance(x, torch.nn.Module):
            self.add(([type(part) for part in x.modules()], str(x), dict(x.state_dict())))
        elif dataclasses.is_dataclass(x) or (not _is_foreign(type(x).__module__) and hasattr(x, "__dict__")):
            self.add(type(x))
            self.add(vars(x))

    def _function(self, f: types.FunctionType) -> None:
        self._text(f"{f.__module__}.{f.__qualname__}")
        if _is_foreign(f.__module__ or ""):
            return
        self._code(f.__code__)
        self.add((f.__defaults__, f.__kwdefaults__, vars(f)))
        for cell in f.__closure__ or ():
            with contextlib.suppress(ValueError):  # not assigned yet
                self.add(cell.cell_contents)
        parts = list(_parts(f.__code__))
        attributes = {name for part in parts for name in part.co_names}
        for name in sorted(attributes):
            self._text(name)
            self._global(f.__globals__.get(name), attributes)
        inside = {i.argval for part in parts for i in dis.get_instructions(part) if i.opname == "IMPORT_NAME"}
        for name in sorted(inside):
            if not _is_foreign(name):
                with contextlib.suppress(ImportError):  # the rule will notice
                    self._global(importlib.import_module(name), attributes)

    def _global(self, x: Any, attributes: set[str]) -> None:
        """A value that code names; of a helper module, what the code can reach of it by these names."""
        if not isinstance(x, types.ModuleType):
            self.add(x)
        elif not _is_foreign(x.__name__) and id(x) not in self._seen:
            self._seen[id(x)] = x
            for name in sorted(attributes & vars(x).keys()):
                self._text(name)
                self._global(getattr(x, name), attributes)

    def _code(self, code: types.CodeType) -> None:
        self.hash.update(code.co_code)
        self._text(repr((code.co_names, code.co_varnames, code.co_freevars)))
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self._code(constant)
            else:
                self.add(constant)

    def _text(self, text: str) -> None:
        self.hash.update(text.encode() + b"\0")


def _parts(code: types.CodeType) -> Iterator[types.CodeType]:
    """The code of a function and of the functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _parts(constant)


MOST_BYTES = 1_000_000


def is_rule_file(text: str) -> bool:
    """Whether ``text`` names a file and a rule in it, rather than a registered rule."""
    return ".py" in text


def read_rule_file(text: str) -> tuple[str, str]:
    """Source and name of the rule that "FILE.py:name" names.

    Raises:
        ValueError: no name, or the file is not text. FileNotFoundError: no such file.
    """
    file, colon, name = text.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise ValueError(f"expected a seeding rule in a file as FILE.py:name, got {shown(text)}")
    path = Path(file).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected the file of the seeding rule {name}")
    return read_text(path, "a seeding rule", at_most=MOST_BYTES), name


def load_rule_file(text: str) -> SeedingRule:
    """The rule that "FILE.py:name" names.

    Raises:
        ValueError: the file cannot be loaded, or has no such rule. FileNotFoundError: no such file.
    """
    source, name = read_rule_file(text)
    return rule_of_source(source, name, text.rpartition(":")[0])


def rule_of_source(source: str, name: str, file: str = "rule.py") -> SeedingRule:
    """The rule ``name`` of a file's source. The rules that it registers are not registered outside of it.

    Args:
        source: The whole file. It may import installed packages and modules on Python's path.
        name: The function or class.
        file: Name of the file for messages.

    Raises:
        ValueError: the source cannot be loaded, or has no such rule. TypeError: its signature is not that of a rule.
    """
    digest = hashlib.blake2b(source.encode(), digest_size=8).hexdigest()
    module = sys.modules.get(f"rule_file_{digest}")
    if module is None:
        module = _load(source, f"rule_file_{digest}", file)
    rule: Any = getattr(module, name, None)
    if rule is None or not callable(rule):
        known = ", ".join(module.__dict__["__rules__"]) or "none"
        raise ValueError(f"{file} has no seeding rule {shown(name)}; it defines: {known}")
    return get_rule(cast(SeedingRule, rule))


def find_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule that is registered by a name, or that "FILE.py:name" names; a function or class is returned unchanged.

    Raises:
        KeyError: no rule of that name. TypeError: bad signature. ValueError, FileNotFoundError: as ``load_rule_file``.
    """
    return load_rule_file(rule) if isinstance(rule, str) and is_rule_file(rule) else get_rule(rule)


def file_source(rule: SeedingRule) -> str:
    """Source of the whole file that a rule was loaded from; empty for a rule that was not loaded from a file."""
    module = sys.modules.get(getattr(rule, "__module__", "") or "")
    return getattr(module, "__rule_source__", "")


def _load(source: str, name: str, file: str) -> types.ModuleType:
    module = types.ModuleType(name)
    module.__file__ = file_name = f"<{Path(file).name} {name[-16:]}>"
    module.__dict__["__rule_source__"] = source
    lines = source.splitlines(keepends=True)
    linecache.cache[file_name] = (len(source), None, lines, file_name)  # for its source in reports
    sys.modules[name] = module  # dataclasses look there
    try:
        with keep_registered() as before:
            exec(compile(source, file_name, "exec"), module.__dict__)
            own = [rule_name(rule) for key, rule in registered().items() if before.get(key) is not rule]
    except Exception as e:
        del sys.modules[name]
        at = [frame.lineno for frame in traceback.extract_tb(e.__traceback__) if frame.filename == file_name]
        line = e.lineno if isinstance(e, SyntaxError) else (at[-1] if at else None)
        where = file if line is None else f"{file}, line {line}"
        raise ValueError(f"{where}: {type(e).__name__}: {getattr(e, 'msg', e)}") from None
    functions = [k for k, v in vars(module).items() if isinstance(v, types.FunctionType) and v.__module__ == name]
    module.__dict__["__rules__"] = list(dict.fromkeys([*own, *(f for f in functions if not f.startswith("_"))]))
    return module
