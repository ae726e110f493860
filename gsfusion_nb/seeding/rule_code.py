"""Seeding rules from files, their source, and the files that they read."""

import ast
import hashlib
import inspect
import linecache
import os
import sys
import textwrap
import traceback
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

from ..checks import shown
from ..errors import ArgumentError
from ..files import UNREADABLE, file_hashes, read_text
from .beside import Beside, sources_digest
from .code_origin import BESIDE, RULE_SOURCE, is_library_code
from .map_rule import SeedingRule, rule_name
from .rule import get_rule, keep_registered, option_paths, registered
from .rule_guard import refuse, watch_reads

_OWN = __name__.partition(".")[0]


def is_built_in(rule: Any) -> bool:
    """The rule is one of this package's, so its name and the package's version say what it does.

    Where somebody's function is around it, or is a method of its class, it is not.
    """
    if not (getattr(rule, "__module__", "") or "").startswith(f"{_OWN}."):
        return False
    if isinstance(rule, type):
        return all(
            is_library_code(member)
            for kind in rule.__mro__
            for member in vars(kind).values()
            if isinstance(member, types.FunctionType)
        )
    while isinstance(rule, types.FunctionType) and is_library_code(rule):
        if not hasattr(rule, "__wrapped__"):
            return True
        rule = rule.__wrapped__
    return False


def rule_source(rule: SeedingRule) -> str:
    """The source code of a rule, or of its class for a callable object; empty where Python does not
    know it."""
    target = (
        inspect.unwrap(rule)
        if inspect.isroutine(rule)
        else rule
        if isinstance(rule, type)
        else type(rule)
    )
    try:
        return textwrap.dedent(inspect.getsource(target))
    except (OSError, TypeError):
        return _source_of_cell(target) if isinstance(target, type) else ""


def _source_of_cell(cls: type) -> str:
    """The source code of a class in a notebook cell, which Python knows by the code of its methods
    only."""
    methods = [
        inspect.unwrap(member) for member in vars(cls).values() if inspect.isfunction(member)
    ]
    for code in (method.__code__ for method in methods):
        lines = linecache.getlines(code.co_filename)
        for node in ast.walk(ast.parse("".join(lines))):
            if (
                isinstance(node, ast.ClassDef)
                and node.name == cls.__name__
                and node.end_lineno is not None
            ):
                first = min(part.lineno for part in (node, *node.decorator_list))
                if first <= code.co_firstlineno <= node.end_lineno:
                    return textwrap.dedent("".join(lines[first - 1 : node.end_lineno]))
    return ""


def rule_files(rule: SeedingRule, options: Mapping[str, Any]) -> dict[str, str]:
    """Option name -> hash of the file or folder, for the options of a rule that are paths, defaults
    included.

    Raises:
        FileNotFoundError: a path that does not exist.
    """
    paths = option_paths(rule, options)
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(
                f"seeding rule {rule_name(rule)!r}: its option {name!r} names {path}, which does "
                "not exist here "
                f"(from {Path.cwd()}); expected the file or folder that the rule reads"
            )
    return {name: path_hash(path) for name, path in paths.items()}


def path_hash(path: Path) -> str:
    """A hash of the content of a file, or of all files in a folder with their names, links
    followed.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    files = [path]
    if path.is_dir():
        folders = os.walk(path, followlinks=True)
        files = sorted(
            f
            for folder, _, names in folders
            for f in (Path(folder, name) for name in names)
            if f.is_file()
        )
    hashes = file_hashes(files)
    for file in files:
        if (file_hash := hashes[os.path.abspath(file)]) == UNREADABLE:
            raise OSError(f"{file} cannot be read; expected a file that the seeding rule reads")
        digest.update(f"{file.relative_to(path)}\0{file_hash}\0".encode())
    return digest.hexdigest()


MOST_BYTES = 1_000_000
RULE_MODULES = "rule_modules"
"""Folder, in that of a run, of the modules that the file of its rule imports from beside it."""


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
        raise ArgumentError(f"expected a seeding rule in a file as FILE.py:name, got {shown(text)}")
    path = Path(file).expanduser()
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; expected the file of the seeding rule {name}"
        )
    return read_text(path, "a seeding rule", at_most=MOST_BYTES), name


def load_rule_file(text: str) -> SeedingRule:
    """The rule that "FILE.py:name" names. It may import the modules beside the file, as a script
    may.

    Raises:
        ValueError: the file cannot be loaded, or has no such rule. FileNotFoundError: no such file.
    """
    source, name = read_rule_file(text)
    return rule_of_source(source, name, text.rpartition(":")[0], rule_folder(text))


def rule_folder(text: str) -> Path:
    """The folder of the modules beside the file that "FILE.py:name" names; in the folder of a run
    it is another one."""
    file = Path(text.rpartition(":")[0]).expanduser().resolve()
    of_a_run = file.parent / RULE_MODULES
    return of_a_run if file.name == "rule.py" and of_a_run.is_dir() else file.parent


def rule_of_source(
    source: str, name: str, file: str = "rule.py", folder: Path | None = None
) -> SeedingRule:
    """The rule ``name`` of a file's source. The rules that it registers are not registered outside
    of it.

    Args:
        source: The whole file. It may import installed packages, modules on Python's path, and
            those in ``folder``.
        name: The function or class.
        file: Name of the file, for messages and for ``__file__``.
        folder: Where the modules beside the file are; None: there are none.

    Raises:
        ValueError: the source cannot be loaded, or has no such rule. TypeError: its signature is
            not that of a rule.
    """
    finder = Beside(folder)
    module_name = f"rule_file_{sources_digest(source.encode(), finder)}"
    module = sys.modules.get(module_name)
    if module is None:
        module = _load(source, module_name, file, finder)
    rule: Any = getattr(module, name, None)
    if rule is None or not callable(rule):
        rule_names = ", ".join(module.__dict__["__rules__"]) or "none"
        raise ArgumentError(f"{file} has no seeding rule {shown(name)}; it defines: {rule_names}")
    return get_rule(cast(SeedingRule, rule))


def find_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule that is registered by a name, or that "FILE.py:name" names; a function or class is
    returned unchanged.

    Raises:
        KeyError: no rule of that name. TypeError: bad signature. ValueError, FileNotFoundError: as
            ``load_rule_file``.
    """
    return load_rule_file(rule) if isinstance(rule, str) and is_rule_file(rule) else get_rule(rule)


def file_source(rule: SeedingRule) -> str:
    """Source of the whole file that a rule was loaded from; empty for a rule that was not loaded
    from a file."""
    return getattr(_module_of(rule), RULE_SOURCE, "")


def beside_sources(rule: SeedingRule) -> dict[str, bytes]:
    """Path, relative to the folder of the rule's file, -> content of the modules that it imports
    from there."""
    module = _module_of(rule)
    finder: Beside | None = getattr(module, BESIDE, None)
    if finder is None or finder.folder is None:
        return {}
    return finder.files_of(file_source(rule).encode())


def refuse_undeclared(rule: SeedingRule, files: Iterable[Path]) -> None:
    """Raise ``UndeclaredError`` if the file of a rule read something undeclared when it was loaded.

    Args:
        rule: The rule.
        files: The files of the modules that are part of its key.
    """
    module = _module_of(rule)
    imported_files = getattr(module, _IMPORTED, frozenset())
    refuse(rule_name(rule), getattr(module, _READ, ""), imported_files - set(files))


_READ = "__undeclared__"
_IMPORTED = "__imported_files__"
"""Names in the module of a rule's file: what it read while it was loaded, and the files that it
imported."""


def _module_of(rule: SeedingRule) -> types.ModuleType | None:
    return sys.modules.get(getattr(rule, "__module__", "") or "")


def _load(source: str, name: str, file: str, finder: Beside) -> types.ModuleType:
    module = types.ModuleType(name)
    path = Path(file).expanduser()
    shown_name = f"<{path.name} {name[-16:]}>"
    module.__file__ = str(path.resolve()) if path.is_file() else shown_name
    vars(module)[RULE_SOURCE] = source
    finder.prepare(module, source.encode())
    lines = source.splitlines(keepends=True)
    linecache.cache[shown_name] = (
        len(source),
        None,
        lines,
        shown_name,
    )  # for its source in reports
    sys.modules[name] = module  # dataclasses look there
    try:
        with keep_registered() as old_rules, watch_reads(Path(file).name) as watch:
            exec(compile(source, shown_name, "exec", dont_inherit=True), module.__dict__)
            own = [
                rule_name(rule)
                for key, rule in registered().items()
                if old_rules.get(key) is not rule
            ]
    except Exception as e:
        del sys.modules[name]
        at = [
            frame.lineno
            for frame in traceback.extract_tb(e.__traceback__)
            if frame.filename == shown_name
        ]
        line = e.lineno if isinstance(e, SyntaxError) else (at[-1] if at else None)
        where = file if line is None else f"{file}, line {line}"
        raise ArgumentError(f"{where}: {type(e).__name__}: {getattr(e, 'msg', e)}") from None
    vars(module)[_READ] = watch.offence
    vars(module)[_IMPORTED] = frozenset(watch.imported_files)
    functions = [
        k
        for k, v in vars(module).items()
        if isinstance(v, types.FunctionType) and v.__module__ == name
    ]
    module.__dict__["__rules__"] = list(
        dict.fromkeys([*own, *(f for f in functions if not f.startswith("_"))])
    )
    return module
