"""A hash of a value and of everything that decides what it does, equal in every process: code,
closures, attributes.

What a value consists of is what the pickle protocol says, with the additions of cloudpickle, so no
kind of value is left out. What cannot be pickled cannot be hashed.
"""

import functools
import hashlib
import io
import pickle
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import cloudpickle
import numpy as np
import torch

from ..errors import ForeseenError
from .code_names import globals_of, imported_inside, looks_up, names_of, walks_sets, words_of
from .code_origin import (
    BESIDE,
    LOADED_SOURCE,
    OWN_PACKAGE,
    RULE_SOURCE,
    home_of,
    is_library,
    is_library_code,
    is_library_module,
)

_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), type(NotImplemented))

_DESCRIPTORS = (
    types.MemberDescriptorType,
    types.GetSetDescriptorType,
    types.WrapperDescriptorType,
    types.MethodDescriptorType,
    types.ClassMethodDescriptorType,
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


class UnhashableError(ForeseenError, ValueError):
    """A value that cannot be hashed; the message says which and why."""


class ValueHash:
    """Puts values into a hash. The same values give the same hash in every process.

    Own functions and classes are hashed with their code and with what the code can reach by the
    names in it. Those of libraries are hashed by their name.

    Args:
        strict: Raise ``UnhashableError`` for a value that cannot be hashed. Otherwise its type
            stands for it.
    """

    def __init__(self, strict: bool = True):
        self.modules: dict[int, types.ModuleType] = {}
        """Own modules that were met, by identity."""
        self.libraries: set[str] = set()
        """Names of the modules of libraries that were met."""
        self.caches: list[Any] = []
        """Functions with ``functools.cache`` or ``lru_cache``, such as one that reads a network."""
        self.walks_sets = False
        """A set was met, or own code that makes one."""
        self._strict = strict
        self._hash = hashlib.blake2b(digest_size=16)
        self._seen: dict[int, tuple[int, Any]] = {}
        self._place: list[str] = []
        self._reducers = cloudpickle.Pickler(io.BytesIO()).dispatch_table
        self._names_at: dict[int, set[str]] = {}
        self._words: set[str] = set()
        """All names in own code, and all texts that could be one."""

    def hexdigest(self) -> str:
        """The hash of all values so far."""
        self._settle()
        return self._hash.hexdigest()

    def _settle(self) -> None:
        """Add what own code names anywhere of the own modules that it has, in whatever way it got
        the module."""
        known = -1
        while known != (known := sum(len(names) for names in self._names_at.values())):
            for module in sorted(self.modules.values(), key=lambda module: module.__name__):
                if module.__name__ != "__main__":  # a notebook has names of all kinds
                    self._module(module, self._words)

    def add(self, value: Any, place: str = "") -> None:
        """Add a value; ``place`` says where it is, for the message if it cannot be hashed.

        Raises:
            UnhashableError: it cannot be hashed.
        """
        if place:
            self._place.append(place)
        try:
            self._add(value)
        except RecursionError:
            raise UnhashableError(f"{self._where()} is nested too deeply") from None
        if place:
            self._place.pop()

    def _add(self, x: Any) -> None:
        kind = type(x)
        self._text(kind.__qualname__)
        if kind in _ATOMS:
            self._text(repr(x))
            if kind is str:
                self._words |= words_of(x)
        elif kind is tuple:
            self._all(x)
        elif kind is frozenset or kind is set:
            self._set(x)
        elif kind is types.CodeType:
            self._code(x)
        elif isinstance(x, types.ModuleType):
            self._module(x)
        elif kind in _DESCRIPTORS:
            self._text(f"{x.__qualname__}")
        elif self._is_new(x):
            self._object(x)

    def _is_new(self, x: Any) -> bool:
        """Whether an object was not met before; one that was is hashed by its number, so that
        circles end."""
        if id(x) in self._seen:
            self._text(f"object {self._seen[id(x)][0]}")
            return False
        self._seen[id(x)] = len(self._seen), x  # kept, so that its identity is not given to another
        return True

    def _object(self, x: Any) -> None:
        if hasattr(x, "cache_clear"):
            self.caches.append(x)
        if isinstance(x, types.FunctionType):
            self._function(x)
        elif isinstance(x, type):
            self._class(x)
        elif isinstance(x, torch.Tensor):
            self._tensor(x)
        elif type(x) is np.ndarray and not x.dtype.hasobject:
            self._text(f"{x.dtype.descr} {x.shape} {x.strides}")
            self._hash.update(np.ascontiguousarray(x).tobytes())
        elif type(x) is list:
            self._all(x)
        elif type(x) is dict:
            self._mapping(x)
        elif isinstance(x, property):
            self._all((x.fget, x.fset, x.fdel))
        elif isinstance(x, classmethod | staticmethod):
            self.add(x.__func__)
        elif isinstance(x, types.MethodType):
            self._all((x.__self__, x.__func__))
        elif isinstance(x, types.MethodWrapperType):
            self._all((x.__self__, x.__name__))
        elif isinstance(x, functools.cached_property):
            self._all((x.func, x.attrname))
        elif isinstance(x, functools._lru_cache_wrapper):
            self._text(repr(x.cache_parameters()))
            self.add(x.__wrapped__)
        elif isinstance(compiled := getattr(x, "py_func", None), types.FunctionType):  # by numba
            self._text(repr(sorted(getattr(x, "targetoptions", {}).items())))
            self.add(compiled)
        elif isinstance(x, io.IOBase):
            self._give_up(x, "it is open")
        elif isinstance(x, types.MappingProxyType):
            self._mapping(dict(x))
        elif not self._by_reference(x):
            self._reduced(x)

    def _all(self, values: Iterable[Any]) -> None:
        count = 0
        for value in values:
            self.add(value)
            count += 1
        self._text(f"{count} items")

    def _mapping(self, x: Mapping[Any, Any]) -> None:
        for key, value in list(x.items()):
            self.add(key)
            self.add(value, f"[{key!r}]" if type(key) in _ATOMS else "")
        self._text(f"{len(x)} items")

    def _attributes(
        self,
        x: Mapping[str, Any],
        without: Iterable[str] = (),
    ) -> None:
        """Values by name, whose order says nothing."""
        for name in sorted(map(str, x.keys() - set(without))):
            self._text(name)
            self.add(x[name], f".{name}")

    def _set(self, x: Iterable[Any]) -> None:
        """Items in the order of their hashes: that of a set differs from process to process."""
        self.walks_sets = True
        digests = []
        for item in x:
            alone = self._another()
            alone.add(item)
            self.modules |= alone.modules
            self.libraries |= alone.libraries
            self._words |= alone._words
            digests.append(alone.hexdigest())
        self._text(" ".join(sorted(digests)))

    def _another(self) -> "ValueHash":
        return ValueHash(self._strict)

    def _tensor(self, x: torch.Tensor) -> None:
        if x.layout is not torch.strided or x.is_quantized or x.is_meta:
            self._reduced(x)
            return
        self._text(f"{x.dtype} {tuple(x.shape)} {x.stride()} {x.requires_grad} {x.device.type}")
        plain = x.detach().cpu().resolve_conj().resolve_neg().contiguous()
        flat = plain.view(-1)
        # one value of a column counts as contiguous, and cannot be seen as bytes
        if flat.stride(0) != 1:
            flat = flat.clone(memory_format=torch.contiguous_format)
        self._hash.update(flat.view(torch.uint8).numpy().tobytes())
        if type(x) not in (torch.Tensor, torch.nn.Parameter):
            self.add(type(x))
        self._attributes(getattr(x, "__dict__", {}))
        if x.is_leaf and x.grad is not None:
            self.add(x.grad, ".grad")

    def _module(
        self,
        x: types.ModuleType,
        names: set[str] | None = None,
    ) -> None:
        """A module, of which ``names`` are looked up."""
        if is_library_module(x):
            self._text(x.__name__)
            self.libraries.add(x.__name__)
            self._library_names(x, names or set())
            return
        self.modules[id(x)] = x
        reached = self._names_at.setdefault(id(x), set())
        for name in sorted(
            ({*(names or ()), "__getattr__"} & vars(x).keys()) - reached - NOT_OF_A_PROGRAM
        ):
            reached.add(name)
            self._text(name)
            self._global(vars(x)[name], names or set(), f"{x.__name__}.{name}")

    def _library_names(self, x: types.ModuleType, names: set[str]) -> None:
        """What a library has by these names, where that is not what it says: constants, and
        functions of others."""
        reached = self._names_at.setdefault(id(x), set())
        for name in sorted((names & vars(x).keys()) - reached):
            reached.add(name)
            value = vars(x)[name]
            if isinstance(value, types.ModuleType):
                if is_library_module(value):
                    self._library_names(value, names)
            elif type(value) in _ATOMS:
                self._text(f"{x.__name__}.{name} {value!r}")
            elif isinstance(value, types.FunctionType) and not is_library_code(value):
                self._text(f"{x.__name__}.{name}")
                self.add(value, f"{x.__name__}.{name}")
            elif is_own_class(type(value)) or (type(value) in _HOLD_VALUES and x.__name__ != "sys"):
                self.add(value, f"{x.__name__}.{name}")
            elif callable(value) and (called := getattr(value, "__name__", name)) != name:
                self._text(f"{x.__name__}.{name} is {called}")

    def _function(self, f: types.FunctionType) -> None:
        home = home_of(f)
        self._text(f"{self._home_name(f.__module__)}.{f.__qualname__}")
        if is_library_code(f):
            self.libraries.add(f.__module__ or "")
            is_its_own = is_library(f.__module__ or "") and _is_importable(f)
            if not is_its_own:  # it was made around something, as by torch.no_grad
                self._closure(f)
                self.add(vars(f).get("__wrapped__"))
            return
        if home is not None:
            self.modules[id(home)] = home
        self.walks_sets = self.walks_sets or walks_sets(f.__code__)
        self._code(f.__code__)
        self.add(f.__defaults__, f"default of {f.__name__}")
        self.add(f.__kwdefaults__, f"default of {f.__name__}")
        self._text(
            repr(sorted((name, _plain_repr(value)) for name, value in f.__annotations__.items()))
        )
        self._attributes(vars(f))
        self._closure(f)
        self._names_of_code(f, home)

    def _closure(self, f: types.FunctionType) -> None:
        for name, cell in zip(
            f.__code__.co_freevars,
            f.__closure__ or (),
            strict=True,
        ):
            try:
                content = cell.cell_contents
            except ValueError:  # not assigned yet
                self._text(f"no {name}")
                continue
            self.add(content, f"{name}, around {f.__name__},")

    def _names_of_code(self, f: types.FunctionType, home: types.ModuleType | None) -> None:
        names = names_of(f.__code__)
        self._words |= names
        by_name = looks_up(f, in_a_module=home is not None and home.__name__ != "__main__")
        if by_name and self._strict:
            raise UnhashableError(
                f"{f.__name__} looks names up by {by_name}, so what it uses is not known"
            )
        loaded = globals_of(f.__code__) - NOT_OF_A_PROGRAM
        for name in sorted(loaded & f.__globals__.keys()):
            self._text(name)
            self._global(f.__globals__[name], names, f"global {name}")
        built_in = f.__builtins__  # pyright: ignore[reportAttributeAccessIssue]
        for name in sorted((loaded & built_in.keys()) - f.__globals__.keys()):
            self._text(name)
            self.add(built_in[name], f"builtin {name}")
        for name in sorted(imported_inside(f)):
            self._global(_imported(name, f), names, name)

    def _global(self, x: Any, names: set[str], place: str) -> None:
        """A value that code names; of a module, what the code can reach of it by these names."""
        if isinstance(x, types.ModuleType):
            self._module(x, names)
        else:
            self.add(x, place)

    def _class(self, x: type) -> None:
        self._text(f"{self._home_name(x.__module__)}.{x.__qualname__}")
        home = sys.modules.get(x.__module__) or self._home_of_methods(x)
        if (
            is_library_module(home)
            if isinstance(home, types.ModuleType)
            else is_library(x.__module__)
        ):
            self.libraries.add(x.__module__)
            return
        if isinstance(home, types.ModuleType):
            self.modules[id(home)] = home
        self._all((type(x), *x.__bases__))
        self._attributes(vars(x), _NOT_OF_A_CLASS)
        notes = vars(x).get("__annotations__", {})
        self._text(repr([(name, _plain_repr(value)) for name, value in notes.items()]))
        self._text(_plain_repr(vars(x).get("__doc__")))

    @staticmethod
    def _home_of_methods(x: type) -> types.ModuleType | None:
        methods = [member for member in vars(x).values() if isinstance(member, types.FunctionType)]
        return next((home for method in methods if (home := home_of(method)) is not None), None)

    @staticmethod
    def _home_name(module: str | None) -> str:
        """Name of a module; that of a rule's file does not depend on where the file is."""
        home = sys.modules.get(module or "")
        return "<rule>" if hasattr(home, RULE_SOURCE) else str(module)

    def _code(self, code: types.CodeType) -> None:
        self._hash.update(code.co_code)
        table = getattr(code, "co_exceptiontable", b"")
        shape = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
        self._text(
            repr(
                (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, shape, table)
            )
        )
        self._all(code.co_consts)

    def _by_reference(self, x: Any) -> bool:
        """Whether an object of a library can be found by its name, and was hashed by it."""
        module = getattr(x, "__module__", None)
        name = getattr(x, "__qualname__", None) or getattr(x, "__name__", None)
        if isinstance(x, types.BuiltinFunctionType) and isinstance(
            x.__self__, types.ModuleType | type
        ):
            self._text(f"{getattr(x.__self__, '__name__', '')}.{x.__qualname__}")
            return True
        if not isinstance(module, str) or not isinstance(name, str) or not is_library(module):
            return False
        if _resolved(module, name) is not x:
            return False
        self._text(f"{module}.{name}")
        return True

    def _reduced(self, x: Any) -> None:
        """An object as pickle would store it."""
        try:
            reducer: Callable[[Any], Any] | None = self._reducers.get(type(x))
            reduced = reducer(x) if reducer is not None else x.__reduce_ex__(4)
        except Exception as e:  # whatever the object's own method raises
            self._give_up(x, str(e))
            return
        if isinstance(reduced, str):
            self._named(x, reduced)
        else:
            self._parts(reduced)
        if not is_library(type(x).__module__):
            self._attributes(_own_attributes(x))  # also what its own __getstate__ leaves out

    def _named(self, x: Any, name: str) -> None:
        """An object that pickle would store by its name."""
        home = pickle.whichmodule(x, name)  # pyright: ignore[reportAttributeAccessIssue]
        self._text(f"{home}.{name}")
        if is_library(type(x).__module__) and _resolved(home, name) is not x:
            self._give_up(x, f"it is not {home}.{name}")

    def _parts(self, reduced: tuple[Any, ...]) -> None:
        make, arguments, *rest = reduced
        self._all((make, *arguments))
        state, listed, mapped = [*rest[:3], None, None, None][:3]
        for part in state if isinstance(state, tuple) and len(state) == 2 else (state,):
            if type(part) is dict and all(type(key) is str for key in part):
                self._attributes(part)
            else:
                self.add(part)
        self._all([] if listed is None else list(listed))
        for key, value in [] if mapped is None else list(mapped):
            self._all((key, value))

    def _give_up(self, x: Any, why: str) -> None:
        if self._strict:
            raise UnhashableError(
                f"{self._where()} is a {type(x).__name__}, which cannot be hashed ({why})"
            )
        self._text("unhashable")

    def _where(self) -> str:
        return (
            "".join(place if place[0] in ".[" else f" {place}" for place in self._place).strip()
            or "a value"
        )

    def _text(self, text: str) -> None:
        self._hash.update(text.encode(errors="surrogatepass") + b"\0")


def _imported(name: str, f: types.FunctionType) -> Any:
    """What ``import name`` inside a function gives; None where it fails, which the rule will
    notice."""
    beside = f.__globals__.get(BESIDE)
    if beside is None or not beside.has(name):
        if name.partition(".")[0] in (OWN_PACKAGE, *sys.stdlib_module_names):
            return None
        if is_library(name):
            return sys.modules.get(name)
    bring = f.__builtins__.get("__import__", __import__)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        return bring(name, f.__globals__, None, ("__name__",))
    except Exception:  # what somebody's module raises
        return None


@functools.lru_cache(maxsize=65536)
def is_own_class(kind: type) -> bool:
    """Whether a class was written in a notebook, or in a file that is no library's."""
    if kind.__module__ == "__main__":
        return True
    home = sys.modules.get(kind.__module__)
    if not isinstance(home, types.ModuleType) or is_library_module(home):
        return False
    return bool(getattr(home, "__file__", None)) or hasattr(home, LOADED_SOURCE)


def _own_attributes(x: Any) -> dict[str, Any]:
    """Attributes of an object of somebody's own class, in its ``__dict__`` and in slots."""
    found = dict(x.__dict__) if type(getattr(x, "__dict__", None)) is dict else {}
    for kind in type(x).__mro__:
        for name, member in vars(kind).items():
            if (
                isinstance(member, types.MemberDescriptorType)
                and not is_library(kind.__module__)
                and hasattr(x, name)
            ):
                found[name] = getattr(x, name)
    return found


def _is_importable(f: types.FunctionType) -> bool:
    return _resolved(f.__module__ or "", f.__qualname__) is f


def _resolved(module: str, name: str) -> Any:
    """What a module has by a dotted name; None if there is no such thing."""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _plain_repr(annotation: Any) -> str:
    """An annotation in words, without addresses."""
    return (
        annotation
        if isinstance(annotation, str)
        else re.sub(r" at 0x[0-9a-fA-F]+", "", repr(annotation))
    )
