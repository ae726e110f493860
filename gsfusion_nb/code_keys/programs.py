"""Functions, classes and modules in a hash: own code with all that it can reach by the names in
it, that of libraries by its name."""

import re
import sys
import types
import typing
from typing import Any

import numpy as np
import torch

from .digest import ATOMS, Digest, UnhashableError
from .names import globals_of, imported_inside, looks_up, named_in, names_of, walks_sets
from .origin import (
    BESIDE,
    LOADED_SOURCE,
    OWN_PACKAGE,
    RULE_SOURCE,
    home_of,
    is_library,
    is_library_code,
    is_library_module,
    is_own_class,
)

_NOT_OF_A_CLASS = {
    "__dict__",
    "__weakref__",
    "__doc__",
    "__module__",
    "__annotations__",
    "__firstlineno__",
    "__static_attributes__",
    "_abc_impl",
}

NOT_OF_A_PROGRAM = {
    "__name__",
    "__file__",
    "__doc__",
    "__builtins__",
    "__spec__",
    "__loader__",
    "__package__",
    "__cached__",
    "__path__",
    "__annotations__",
    "__import__",
    "__build_class__",
    "__debug__",
    "__rules__",
    "__registered__",
    "__undeclared__",
    "__imported_files__",
    "display",
    "get_ipython",
    LOADED_SOURCE,
    RULE_SOURCE,
    BESIDE,
}
"""Names that Python, or what loads a module or runs a notebook, sets by itself."""

_HOLD_VALUES = (list, tuple, dict, set, frozenset, np.ndarray, torch.Tensor)
"""Kinds of what somebody may put into a library to look it up there."""


def add_module(digest: Digest, x: types.ModuleType, names: set[str] | None = None) -> None:
    """A module, of which ``names`` are looked up."""
    if is_library_module(x):
        digest.text(x.__name__)
        digest.libraries.add(x.__name__)
        _add_library_names(digest, x, names or set())
        return
    if type(x) is not types.ModuleType and id(x) not in digest.modules:
        digest.add(type(x), f"class of {x.__name__}")
    digest.modules[id(x)] = x
    old_names = digest.names_at.setdefault(id(x), set())
    for name in sorted(
        ({*(names or ()), "__getattr__"} & vars(x).keys()) - old_names - NOT_OF_A_PROGRAM
    ):
        old_names.add(name)
        digest.text(name)
        _add_global(digest, vars(x)[name], names or set(), f"{x.__name__}.{name}")


def _add_library_names(digest: Digest, x: types.ModuleType, names: set[str]) -> None:
    """What a library has by these names, where that is not what it says: constants, and
    functions of others."""
    old_names = digest.names_at.setdefault(id(x), set())
    for name in sorted((names & vars(x).keys()) - old_names):
        old_names.add(name)
        value = vars(x)[name]
        if isinstance(value, types.ModuleType):
            if is_library_module(value):
                _add_library_names(digest, value, names)
        elif type(value) in ATOMS:
            digest.text(f"{x.__name__}.{name} {value!r}")
        elif isinstance(value, types.FunctionType) and not is_library_code(value):
            digest.text(f"{x.__name__}.{name}")
            digest.add(value, f"{x.__name__}.{name}")
        elif is_own_class(type(value)) or (type(value) in _HOLD_VALUES and x.__name__ != "sys"):
            digest.add(value, f"{x.__name__}.{name}")
        elif callable(value) and (own_name := getattr(value, "__name__", name)) != name:
            digest.text(f"{x.__name__}.{name} is {own_name}")


def add_function(digest: Digest, f: types.FunctionType) -> None:
    """A function: one of a library by its name, an own one with its code, its defaults and what
    its names lead to."""
    home = home_of(f)
    digest.text(f"{_home_name(f.__module__)}.{f.__qualname__}")
    if is_library_code(f):
        digest.libraries.add(f.__module__ or "")
        is_its_own = is_library(f.__module__ or "") and _is_importable(f)
        if not is_its_own:  # it was made around something, as by torch.no_grad
            _add_closure(digest, f)
            digest.add(vars(f).get("__wrapped__"))
        return
    if home is not None:
        digest.modules[id(home)] = home
    digest.walks_sets = digest.walks_sets or walks_sets(f.__code__)
    add_code(digest, f.__code__)
    digest.add(f.__defaults__, f"default of {f.__name__}")
    digest.add(f.__kwdefaults__, f"default of {f.__name__}")
    digest.text(
        repr(sorted((name, _plain_repr(value)) for name, value in f.__annotations__.items()))
    )
    digest.add_attributes(vars(f))
    _add_closure(digest, f)
    _add_names(digest, f, home)


def _add_closure(digest: Digest, f: types.FunctionType) -> None:
    for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
        try:
            content = cell.cell_contents
        except ValueError:  # not assigned yet
            digest.text(f"no {name}")
            continue
        digest.add(content, f"{name}, around {f.__name__},")


def _add_names(digest: Digest, f: types.FunctionType, home: types.ModuleType | None) -> None:
    names = names_of(f.__code__)
    digest.words |= names
    by_name = looks_up(f, in_a_module=home is not None and home.__name__ != "__main__")
    if by_name and digest.strict:
        raise UnhashableError(
            f"{f.__name__} looks names up by {by_name}, so what it uses is not known"
        )
    global_names = globals_of(f.__code__) - NOT_OF_A_PROGRAM
    for name in sorted(global_names & f.__globals__.keys()):
        digest.text(name)
        _add_global(digest, f.__globals__[name], names, f"global {name}")
    built_in = f.__builtins__  # pyright: ignore[reportAttributeAccessIssue]
    for name in sorted((global_names & built_in.keys()) - f.__globals__.keys()):
        digest.text(name)
        digest.add(built_in[name], f"builtin {name}")
    for name in sorted(imported_inside(f)):
        _add_global(digest, _import_value(name, f), names, name)


def _add_global(digest: Digest, x: Any, names: set[str], place: str) -> None:
    """A value that code names; of a module, what the code can reach of it by these names."""
    if isinstance(x, types.ModuleType):
        add_module(digest, x, names)
    else:
        digest.add(x, place)


def add_class(digest: Digest, x: type) -> None:
    """A class: one of a library by its name, an own one with its bases and attributes."""
    digest.text(f"{_home_name(x.__module__)}.{x.__qualname__}")
    home = sys.modules.get(x.__module__) or _home_of_methods(x)
    has_module = isinstance(home, types.ModuleType)
    of_library = is_library_module(home) if has_module else is_library(x.__module__)
    if of_library:
        digest.libraries.add(x.__module__)
        return
    if has_module:
        digest.modules[id(home)] = home
    digest.add_all((type(x), *x.__bases__))
    digest.add_attributes(vars(x), _NOT_OF_A_CLASS)
    annotations = vars(x).get("__annotations__", {})
    digest.text(repr([(name, _plain_repr(value)) for name, value in annotations.items()]))
    digest.text(_plain_repr(vars(x).get("__doc__")))


def _home_of_methods(x: type) -> types.ModuleType | None:
    """The module of a class, as its methods know it; a library's function can be among them, as in
    an enumeration."""
    methods = [member for member in vars(x).values() if isinstance(member, types.FunctionType)]
    homes = (home_of(method) for method in methods)
    return next(
        (home for home in homes if home is not None and home.__name__ == x.__module__), None
    )


def _home_name(module: str | None) -> str:
    """Name of a module; that of a rule's file does not depend on where the file is."""
    home = sys.modules.get(module or "")
    return "<rule>" if hasattr(home, RULE_SOURCE) else str(module)


def add_code(digest: Digest, code: types.CodeType) -> None:
    """Compiled code, without the file and the lines that it comes from."""
    digest.data(code.co_code)
    table = getattr(code, "co_exceptiontable", b"")
    shape = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    digest.text(
        repr((code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, shape, table))
    )
    digest.add_all(code.co_consts)


def _import_value(name: str, f: types.FunctionType) -> Any:
    """What ``import name`` inside a function gives; None where it fails, which the rule will
    notice."""
    finder = f.__globals__.get(BESIDE)
    if finder is None or not finder.has(name):
        if name.partition(".")[0] in (OWN_PACKAGE, *sys.stdlib_module_names):
            return None
        if is_library(name):
            return sys.modules.get(name)
    bring = f.__builtins__.get("__import__", __import__)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        return bring(name, f.__globals__, None, ("__name__",))
    except Exception:  # what somebody's module raises
        return None


def _is_importable(f: types.FunctionType) -> bool:
    return named_in(f.__module__ or "", f.__qualname__) is f


def _plain_repr(annotation: Any) -> str:
    """An annotation in words, without addresses, without the help texts that the command line
    attaches to settings, and without where the file of a rule or a system is."""
    if typing.get_origin(annotation) is typing.Annotated:
        kind, *marks = typing.get_args(annotation)
        own = [mark for mark in marks if not type(mark).__module__.startswith("tyro")]
        return _plain_repr(kind) + "".join(map(_plain_repr, own))
    if isinstance(annotation, str):
        return annotation
    text = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(annotation))
    return re.sub(r"\b\w+(?=\.)", lambda module: _home_name(module[0]), text)
