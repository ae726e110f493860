"""Seeding rules from files, their source, and the files that they read."""

import ast
import hashlib
import inspect
import linecache
import os
import textwrap
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from ..checks import shown
from ..code_keys.origin import is_library_code
from ..errors import ArgumentError
from ..files import UNREADABLE, file_hashes
from .code_files import (
    code_folder,
    definitions_in,
    is_code_file,
    module_of_source,
    read_code_file,
)
from .map_rule import SeedingRule, rule_name
from .rule import get_rule, option_paths

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


def load_rule_file(text: str) -> SeedingRule:
    """The rule that "FILE.py:name" names. It may import the modules beside the file, as a script
    may.

    Raises:
        ValueError: the file cannot be loaded, or has no such rule. FileNotFoundError: no such file.
    """
    source, name = read_code_file(text)
    return rule_of_source(source, name, text.rpartition(":")[0], code_folder(text))


def rule_of_source(
    source: str, name: str, file: str = "rule.py", folder: Path | None = None
) -> SeedingRule:
    """The rule ``name`` of a file's source (``module_of_source``).

    Raises:
        ValueError: the source cannot be loaded, or has no such rule. TypeError: its signature is
            not that of a rule.
    """
    module = module_of_source(source, file, folder)
    rule: Any = getattr(module, name, None)
    if rule is None or not callable(rule):
        rule_names = ", ".join(definitions_in(module)) or "none"
        raise ArgumentError(f"{file} has no seeding rule {shown(name)}; it defines: {rule_names}")
    return get_rule(cast(SeedingRule, rule))


def find_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule that is registered by a name, or that "FILE.py:name" names; a function or class is
    returned unchanged.

    Raises:
        KeyError: no rule of that name. TypeError: bad signature. ValueError, FileNotFoundError: as
            ``load_rule_file``.
    """
    return load_rule_file(rule) if isinstance(rule, str) and is_code_file(rule) else get_rule(rule)
