"""Python files that the user names, as FILE.py:name: a seeding rule, or a mapping system. They may
import the modules beside them, as a script may."""

import linecache
import sys
import traceback
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..checks import shown
from ..code_keys.origin import BESIDE, RULE_SOURCE
from ..errors import ArgumentError
from ..files import read_text
from .beside import Beside, sources_digest
from .map_rule import SeedingRule, rule_name
from .rule import keep_registered, registered, seeding_rule
from .rule_guard import refuse, watch_reads

MOST_BYTES = 1_000_000
RULE_MODULES = "rule_modules"
"""Folder, in that of a run, of the modules that the file of its rule imports from beside it."""
SYSTEM_MODULES = "system_modules"
"""The same of the file of its system."""
_MODULES_IN_RUN = {"rule.py": RULE_MODULES, "system.py": SYSTEM_MODULES}
_READ = "__undeclared__"
_IMPORTED = "__imported_files__"
_DEFINED = "__rules__"
_REGISTERED = "__registered__"
"""Names in the module of a file: what it read while it was loaded, the files that it imported, the
functions that it defines, and the rules that it registers."""


def is_code_file(text: str) -> bool:
    """Whether ``text`` names a file and something in it, rather than something by its name
    alone."""
    return ".py" in text


def read_code_file(text: str, what: str = "a seeding rule") -> tuple[str, str]:
    """Source of the file that "FILE.py:name" names, and the name.

    Args:
        text: The file, and what of it.
        what: Its kind, for messages: "a seeding rule", "a mapping system".

    Raises:
        ValueError: no name, or the file is not text. FileNotFoundError: no such file.
    """
    file, colon, name = text.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise ArgumentError(f"expected {what} in a file as FILE.py:name, got {shown(text)}")
    path = Path(file).expanduser()
    if not path.is_file():
        kind = what.partition(" ")[2]
        raise FileNotFoundError(f"{path} does not exist; expected the file of the {kind} {name}")
    return read_text(path, what, at_most=MOST_BYTES), name


def code_folder(text: str) -> Path:
    """The folder of the modules beside the file that "FILE.py:name" names; in the folder of a run
    it is another one."""
    file = Path(text.rpartition(":")[0]).expanduser().resolve()
    of_a_run = file.parent / _MODULES_IN_RUN.get(file.name, "")
    return of_a_run if file.name in _MODULES_IN_RUN and of_a_run.is_dir() else file.parent


def module_of_source(source: str, file: str, folder: Path | None = None) -> types.ModuleType:
    """The module of a file's source, loaded once in a process. The rules that it registers are not
    registered outside of it.

    Args:
        source: The whole file. It may import installed packages, modules on Python's path, and
            those in ``folder``.
        file: Name of the file, for messages and for ``__file__``.
        folder: Where the modules beside the file are; None: there are none.

    Raises:
        ValueError: the source cannot be loaded.
    """
    finder = Beside(folder)
    module_name = f"code_file_{sources_digest(source.encode(), finder)}"
    module = sys.modules.get(module_name)
    return _load(source, module_name, file, finder) if module is None else module


def definitions_in(module: types.ModuleType) -> list[str]:
    """Names of the rules and functions that a file defines."""
    return module.__dict__[_DEFINED]


def register_rules_in(module: types.ModuleType, origin: str) -> None:
    """Register the rules that a file registers also outside of it. An earlier one of a file, of the
    same name, is replaced.

    Args:
        module: Of the file.
        origin: The file, for the message.

    Raises:
        ValueError: a rule of no file has one of the names. None is registered then.
    """
    rules = vars(module)[_REGISTERED]
    taken = [name for name in rules if name in registered() and not file_source(registered()[name])]
    if taken:
        raise ArgumentError(
            f"{origin}: there is a seeding rule {taken[0]!r} already; choose another name"
        )
    for rule in rules.values():
        seeding_rule(rule)


def file_source(thing: Any) -> str:
    """Source of the whole file that a rule or a system was loaded from; empty for one that was not
    loaded from a file."""
    return getattr(_module_of(thing), RULE_SOURCE, "")


def beside_sources(thing: Any) -> dict[str, bytes]:
    """Path, relative to the folder of a rule's or system's file, -> content of the modules that it
    imports from there."""
    finder: Beside | None = getattr(_module_of(thing), BESIDE, None)
    if finder is None or finder.folder is None:
        return {}
    return finder.files_of(file_source(thing).encode())


def file_of(thing: Any) -> tuple[str, Path | None]:
    """The file that a rule or a system was loaded from, and the folder of the modules beside it;
    empty, and None, for one that was not loaded from a file."""
    module = _module_of(thing)
    finder: Beside | None = getattr(module, BESIDE, None)
    if finder is None or not file_source(thing):
        return "", None
    return str(getattr(module, "__file__", "")), finder.folder


def refuse_undeclared(rule: SeedingRule, files: Iterable[Path]) -> None:
    """Raise ``UndeclaredError`` if the file of a rule read something undeclared when it was loaded.

    Args:
        rule: The rule.
        files: The files of the modules that are part of its key.
    """
    module = _module_of(rule)
    imported_files = getattr(module, _IMPORTED, frozenset())
    refuse(rule_name(rule), getattr(module, _READ, ""), imported_files - set(files))


def _module_of(thing: Any) -> types.ModuleType | None:
    return sys.modules.get(getattr(thing, "__module__", "") or "")


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
            own = {
                rule_name(rule): rule
                for key, rule in registered().items()
                if old_rules.get(key) is not rule
            }
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
    vars(module)[_REGISTERED] = own
    vars(module)[_DEFINED] = list(
        dict.fromkeys([*own, *(f for f in functions if not f.startswith("_"))])
    )
    return module
