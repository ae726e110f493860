"""The names by which code reaches what it uses: of globals, attributes and modules, and those that
it makes itself."""

import contextlib
import dis
import importlib.util
import sys
import types
from collections.abc import Iterator
from typing import Any

_BY_NAME = {"globals", "eval", "exec", "vars", "locals"}
"""Builtins that look names up while a program runs."""
_ANYWHERE = {
    "_getframe",
    "_current_frames",
    "currentframe",
    "__globals__",
    "f_globals",
    "f_locals",
    "get_objects",
    "__subclasses__",
}
"""Attributes by which a program reaches names of other modules, or all objects of the process."""
_MAKE_SETS = {"BUILD_SET", "SET_ADD", "SET_UPDATE"}
_OF_VIEWS = {"&", "|", "^", "-"}
"""Operators that make sets of the views of a dict: ``a.keys() & b.keys()``."""
_OF_SYS = {"modules", "argv", "orig_argv", "stdin"}


def parts_of(code: types.CodeType) -> Iterator[types.CodeType]:
    """The code of a function and of the functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from parts_of(constant)


def names_of(code: types.CodeType) -> set[str]:
    """All names of globals, attributes and imports in code, and in the functions inside it."""
    return {name for part in parts_of(code) for name in part.co_names}


def globals_of(code: types.CodeType) -> set[str]:
    """The names in code, and in the functions inside it, that are looked up among globals and
    builtins."""
    instructions = (i for part in parts_of(code) for i in dis.get_instructions(part))
    return {
        i.argval
        for i in instructions
        if i.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
    }


def words_of(text: str) -> set[str]:
    """The names in a text that may be one, as for ``operator.attrgetter("grid.step")``; none in a
    sentence."""
    words = text.split(".")
    return set(words) if all(word.isidentifier() for word in words) else set()


def imported_inside(f: types.FunctionType) -> set[str]:
    """Modules that a function imports while it runs, by their full names."""
    package = (
        f.__globals__.get("__package__") or (f.__globals__.get("__name__") or "").rpartition(".")[0]
    )
    modules = set()
    for code in parts_of(f.__code__):
        instructions = list(dis.get_instructions(code))
        for i, instruction in enumerate(instructions):
            if instruction.opname == "IMPORT_NAME":
                level = instructions[i - 2].argval  # put on the stack before the names
                name = (
                    "." * level + instruction.argval
                    if isinstance(level, int)
                    else instruction.argval
                )
                with contextlib.suppress(ImportError):
                    modules.add(importlib.util.resolve_name(name, package))
    return modules


def named_in(module: str, name: str) -> Any:
    """What a module has by a dotted name; None if there is no such thing."""
    value: Any = sys.modules.get(module)
    for part in name.split("."):
        value = getattr(value, part, None)
    return value


def walks_sets(code: types.CodeType) -> bool:
    """Whether code makes a set, or asks for hashes: what it does may depend on the order of texts
    in a set, which differs from process to process."""
    for part in parts_of(code):
        names = set(part.co_names)
        makes = {i.opname for i in dis.get_instructions(part)}
        operators = {
            i.argrepr.rstrip("=") for i in dis.get_instructions(part) if i.opname == "BINARY_OP"
        }
        if {"set", "frozenset", "hash"} & names or _MAKE_SETS & makes:
            return True
        if {"keys", "items"} & names and _OF_VIEWS & operators:
            return True
        if any(isinstance(constant, frozenset) for constant in part.co_consts):
            return True
    return False


def looks_up(f: types.FunctionType, *, in_a_module: bool) -> str:
    """By what a function looks up names that it does not say; empty if it does not.

    Args:
        f: The function.
        in_a_module: Its names are those of a module, of which everything can be hashed; not of a
            notebook.
    """
    names = names_of(f.__code__)
    if words := sorted(_ANYWHERE & names):
        return words[0]
    if "sys" in names and (words := sorted(_OF_SYS & names)):
        return f"sys.{words[0]}"
    if in_a_module or not _BY_NAME & names - f.__globals__.keys():
        return ""
    words = sorted(_BY_NAME & globals_of(f.__code__))  # ``net.eval()`` is no such builtin
    return f"{words[0]}()" if words else ""
