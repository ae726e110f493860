"""Source code of a seeding rule, and a hash of its code and of the values that it stores."""

import ast
import dataclasses
import dis
import functools
import hashlib
import inspect
import linecache
import textwrap
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from .rule_signature import SeedingRule

_OWN = __name__.partition(".")[0]
_PLAIN = (type(None), bool, int, float, complex, str, bytes)


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


def rule_fingerprint(rule: SeedingRule) -> str:
    """A hash of the rule's code, defaults, closure, attributes, and the values and functions that its code names.

    It changes when the rule is edited, and when the rule stores something from one call to the next; of a class it
    covers the base classes, too. For a callable object with ``state_dict`` only the class is hashed, because its state
    is saved with the map. Of what other packages define only the names are hashed.
    """
    feed = _Feed()
    is_object = not isinstance(rule, type) and not inspect.isroutine(rule)
    feed.value(type(rule) if is_object and hasattr(rule, "state_dict") else rule)
    return feed.hash.hexdigest()


class _Feed:
    """Puts values into a hash, each with its type, each object once."""

    def __init__(self):
        self.hash = hashlib.blake2b(digest_size=16)
        self._seen: dict[int, Any] = {}
        self._module = ""

    def value(self, x: Any) -> None:
        """Any value; of an unknown kind of value only its type."""
        self._text(type(x).__qualname__)
        if isinstance(x, _PLAIN):
            self._text(repr(x))
            return
        if id(x) in self._seen:
            return
        self._seen[id(x)] = x  # kept, so that its id is not given to another
        if isinstance(x, (torch.Tensor, np.ndarray)):
            self._array(x)
        elif isinstance(x, Mapping):
            for key in sorted(x, key=repr):
                self.value(key)
                self.value(x[key])
        elif isinstance(x, (list, tuple)):
            for item in x:
                self.value(item)
        elif isinstance(x, (set, frozenset)):
            self._text(repr(sorted(map(repr, x))))
        elif isinstance(x, torch.Generator):
            self._array(x.get_state())
        elif isinstance(x, np.random.Generator):
            self.value(x.bit_generator.state)
        else:
            self._object(x)

    def _object(self, x: Any) -> None:
        if isinstance(x, functools.partial):
            self.value((x.func, x.args, x.keywords))
        elif isinstance(x, types.MethodType):
            self.value((x.__self__, x.__func__))
        elif isinstance(x, types.FunctionType):
            self._function(inspect.unwrap(x))
        elif isinstance(x, type):
            self._text(f"{x.__module__}.{x.__qualname__}")
            if self._is_near(x.__module__):
                for base in x.__bases__:
                    self.value(base)
                for name, member in sorted(vars(x).items()):
                    if not name.startswith("__") or name in ("__call__", "__post_init__"):
                        self.value(member)
        elif dataclasses.is_dataclass(x) and type(x).__module__.startswith(f"{_OWN}."):  # such as when a rule is due
            self.value([getattr(x, field.name) for field in dataclasses.fields(x)])
        elif self._is_near(type(x).__module__) and hasattr(x, "__dict__"):
            self.value(type(x))
            self.value(vars(x))

    def _function(self, f: types.FunctionType) -> None:
        self._text(f"{f.__module__}.{f.__qualname__}")
        if not self._is_near(f.__module__):
            return
        self._code(f.__code__)
        self.value((f.__defaults__, f.__kwdefaults__))
        for cell in f.__closure__ or ():
            try:
                self.value(cell.cell_contents)
            except ValueError:  # not assigned yet
                self._text("empty cell")
        self.value({k: v for k, v in vars(f).items() if k != "__wrapped__"})
        for name in sorted(_names(f.__code__)):
            found = f.__globals__.get(name)
            if not isinstance(found, types.ModuleType):
                self._text(name)
                self.value(found)

    def _code(self, code: types.CodeType) -> None:
        self.hash.update(code.co_code)
        self._text(repr((code.co_names, code.co_varnames, code.co_freevars)))
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self._code(constant)
            else:
                self.value(constant)

    def _is_near(self, module: str | None) -> bool:
        """Whether the module is the one in which the rule is written; of others only names are hashed."""
        module = module or ""
        if not self._module and not module.startswith(f"{_OWN}.") and module.split(".")[0] not in ("torch", "numpy"):
            self._module = module
        return module == self._module

    def _array(self, x: Any) -> None:
        array = x.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy() if isinstance(x, torch.Tensor) else x
        self._text(f"{x.dtype} {tuple(x.shape)}")
        self.hash.update(np.ascontiguousarray(array).tobytes())

    def _text(self, text: str) -> None:
        self.hash.update(text.encode() + b"\0")


def _names(code: types.CodeType) -> set[str]:
    """Names that a function and the functions inside it look up globally."""
    own = {i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "STORE_GLOBAL", "LOAD_NAME")}
    return own.union(*(_names(c) for c in code.co_consts if isinstance(c, types.CodeType)))
