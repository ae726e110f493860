"""Seeding rules from files: "my_rules.py:near_only" is the rule ``near_only`` that the file defines."""

import hashlib
import linecache
import sys
import traceback
import types
from pathlib import Path
from typing import Any, cast

from ..errors import shown
from ..foreign import read_text
from .rule import SeedingRule, get_rule, keep_registered, registered, rule_name

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
    module.__file__ = place = f"<{Path(file).name} {name[-16:]}>"
    module.__dict__["__rule_source__"] = source
    linecache.cache[place] = (len(source), None, source.splitlines(keepends=True), place)  # for its source in reports
    sys.modules[name] = module  # dataclasses look there
    try:
        with keep_registered() as before:
            exec(compile(source, place, "exec"), module.__dict__)
            own = [rule_name(rule) for key, rule in registered().items() if before.get(key) is not rule]
    except Exception as e:
        del sys.modules[name]
        lines = [frame.lineno for frame in traceback.extract_tb(e.__traceback__) if frame.filename == place]
        line = e.lineno if isinstance(e, SyntaxError) else (lines[-1] if lines else None)
        where = file if line is None else f"{file}, line {line}"
        raise ValueError(f"{where}: {type(e).__name__}: {getattr(e, 'msg', e)}") from None
    functions = [k for k, v in vars(module).items() if isinstance(v, types.FunctionType) and v.__module__ == name]
    module.__dict__["__rules__"] = list(dict.fromkeys([*own, *(f for f in functions if not f.startswith("_"))]))
    return module
