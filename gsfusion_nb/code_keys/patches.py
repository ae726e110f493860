"""Functions of libraries that a program has replaced by its own, and switches of torch.

They decide what all code of a process does.
"""

import decimal
import functools
import locale
import sys
import types
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from .origin import is_library_code, is_library_module, is_made_by_library, is_own_class
from .values import ValueHash

_CALLED = (
    types.FunctionType,
    types.BuiltinFunctionType,
    types.MethodDescriptorType,
    types.MethodType,
    type,
    property,
    classmethod,
    staticmethod,
    functools.partial,
)
_PACKAGE = __name__.partition(".")[0]
_NOTHING = object()
_AROUND_FUNCTIONS = (
    types.MethodType,
    staticmethod,
    classmethod,
    functools.partial,
    property,
    functools._lru_cache_wrapper,
)
_HOOKS = {"builtins._", "builtins.display", "builtins.get_ipython"}
"""What interactive programs set, and no computation reads."""
_WRITES_METHODS = {"multiprocessing.managers", "multiprocessing.sharedctypes", "turtle"}
"""Python's own modules that write methods of their classes as text, and execute it in a namespace
that says nothing of a module. No number of a map comes from them."""


def patches() -> dict[str, str]:
    """Name in a loaded library -> hash of somebody's own function or object there. It takes about
    0.15 s."""
    hashes: dict[str, str] = {}
    for place, names, owner in _namespaces():
        home = owner.__module__ if isinstance(owner, type) else owner.__name__
        for name, value in list(names.items()):
            kind = type(value)
            if kind is types.FunctionType:
                if id(value.__globals__) in _known_libraries:
                    continue
            elif kind not in _AROUND_FUNCTIONS and not is_own_class(kind):
                continue
            own = value if is_own_class(kind) else _own_function(value)
            if home in _WRITES_METHODS and _has_no_module(own):
                continue
            if own is not None and place != "sys" and f"{place}.{name}" not in _HOOKS:
                code = ValueHash(strict=False)
                code.add(own)
                hashes[f"{place}.{name}"] = code.hexdigest()
    return hashes


def switches() -> dict[str, str]:
    """The settings of torch, numpy and Python that change results and hold for the whole
    process."""
    return {
        "default dtype": str(torch.get_default_dtype()),
        "default device": str(torch.get_default_device()),
        "matmul precision": torch.get_float32_matmul_precision(),
        "deterministic": str(torch.are_deterministic_algorithms_enabled()),
        "gradients": str(torch.is_grad_enabled()),
        "small numbers": "kept" if float(torch.tensor([1e-40], device="cpu") * 1.0) else "zero",
        "oneDNN": str(torch.backends.mkldnn.enabled),
        "TF32": f"{torch.backends.cuda.matmul.allow_tf32} {torch.backends.cudnn.allow_tf32}",
        "cuDNN": str(
            [
                getattr(torch.backends.cudnn, name)
                for name in ("enabled", "benchmark", "deterministic")
            ]
        ),
        "mixed precision": _mixed_precision(),
        "function modes": _kinds(torch.overrides._get_current_function_mode_stack()),
        "hooks of all networks": _global_hooks(),
        "numpy errors": str(sorted(np.geterr().items())),
        "decimal": _decimal_context(),
        "locale of numbers": locale.setlocale(locale.LC_NUMERIC),
    }


def _mixed_precision() -> str:
    """Types in which ``torch.autocast`` computes now; empty if it is off."""
    kinds = [
        f"{device} {torch.get_autocast_dtype(device)}"
        for device in ("cpu", "cuda")
        if torch.is_autocast_enabled(device)
    ]
    return ", ".join(kinds)


def _kinds(objects: Iterable[Any]) -> str:
    """Names of the classes of objects, in their order."""
    return ", ".join(f"{type(x).__module__}.{type(x).__qualname__}" for x in objects)


def _global_hooks() -> str:
    """A hash of the functions that are called around every network of the process; empty if there
    are none."""
    names = vars(torch.nn.modules.module)
    hooks = [
        (name, list(value.values()))
        for name, value in sorted(names.items())
        if name.startswith("_global_") and isinstance(value, dict) and value
    ]
    if not hooks:
        return ""
    digest = ValueHash(strict=False)
    digest.add(hooks)
    return digest.hexdigest()


def _decimal_context() -> str:
    """How Python's decimal numbers are computed; without the signals of what was computed."""
    context = decimal.getcontext()
    traps = sorted(signal.__name__ for signal, is_on in context.traps.items() if is_on)
    limits = (context.Emin, context.Emax, context.capitals, context.clamp)
    return f"{context.prec} {context.rounding} {limits} {traps}"


@dataclass(frozen=True)
class Namespace:
    """The names of a module, or of a class, as they were."""

    name: str
    owner: Any
    names: dict[str, Any]
    contents: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Of this package: name of a function -> its code, its defaults and its attributes."""


def library_state(*libraries: str) -> list[Namespace]:
    """The names of loaded libraries and their classes, to compare with later by ``changes_since``.

    Args:
        libraries: Beginnings of the names of modules; all by default.
    """
    return [
        Namespace(
            name,
            owner,
            dict(names),
            _function_contents(names) if name.startswith(_PACKAGE) else {},
        )
        for name, names, owner in _namespaces()
        if not libraries or f"{name}.".startswith(libraries)
    ]


def changes_since(state: list[Namespace], *, all_of_package: bool = False) -> list[str]:
    """Names in libraries whose function, class or number is another one than it was, sorted; of
    this package also functions with other code, defaults or attributes, and new names of classes.

    Args:
        state: What ``library_state`` gave.
        all_of_package: Of this package every name that is new, or has any other value.
    """
    return sorted(name for name, _ in _changes(state, all_of_package))


def changed_values(state: list[Namespace]) -> dict[str, str]:
    """The names that ``changes_since`` gives, each with a hash of what it leads to now."""
    hashes = {}
    for name, value in _changes(state, False):
        content = ValueHash(strict=False)
        content.add(value)
        content.add(_function_content(value))
        hashes[name] = content.hexdigest()
    return hashes


def _changes(
    state: list[Namespace],
    all_of_package: bool,
) -> Iterator[tuple[str, Any]]:
    for namespace in state:
        for key, value in list(vars(namespace.owner).items()):
            if _is_change(namespace, key, value, all_of_package):
                yield f"{namespace.name}.{key}", value


def _is_change(namespace: Namespace, key: str, value: Any, all_of_package: bool) -> bool:
    if issubclass(type(value), types.ModuleType):
        return False
    if key.startswith("__"):
        return _is_other_operator(namespace, key, value)
    if (
        all_of_package
        and namespace.name.startswith(_PACKAGE)
        and namespace.names.get(key, _NOTHING) is not value
    ):
        return True
    bases = namespace.owner.__mro__[1:] if isinstance(namespace.owner, type) else ()
    # a new name of a module is lazy
    base_value = next((vars(base)[key] for base in bases if key in vars(base)), value)
    was = namespace.names.get(key, base_value)
    if was is value:
        is_new = (
            key not in namespace.names
            and bool(bases)
            and base_value is value
            and namespace.name.startswith(_PACKAGE)
        )
        return is_new or (
            key in namespace.contents
            and not _are_same(namespace.contents[key], _function_content(value))
        )
    if issubclass(type(value), _CALLED):
        return issubclass(type(was), _CALLED)
    is_number = type(value) in (int, float, str, bool, tuple)
    return is_number and type(was) is type(value) and not key.startswith("_") and value != was


def _is_other_operator(namespace: Namespace, key: str, value: Any) -> bool:
    """Whether a class has another function for what Python calls by a name with underscores, such
    as an operator."""
    if not isinstance(namespace.owner, type):
        return False
    bases = namespace.owner.__mro__[1:]
    base_value = next((vars(base)[key] for base in bases if key in vars(base)), value)
    was = namespace.names.get(key, base_value)
    return was is not value and all(
        issubclass(type(x), _CALLED) and not isinstance(x, type) for x in (was, value)
    )


def _function_contents(names: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    return {
        name: content
        for name, value in list(names.items())
        if (content := _function_content(value))
    }


def _function_content(value: Any) -> tuple[Any, ...]:
    """What decides what a function does and can be changed without giving its name to another
    one."""
    function = value.__func__ if isinstance(value, staticmethod | classmethod) else value
    if type(function) is not types.FunctionType:
        return ()
    attributes = [part for pair in sorted(vars(function).items()) for part in pair]
    return function.__code__, function.__defaults__, function.__kwdefaults__, *attributes


def _are_same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return len(a) == len(b) and all(
        x is y or (type(x) is type(y) is str and x == y) for x, y in zip(a, b, strict=True)
    )


def _namespaces() -> Iterator[tuple[str, Any, Any]]:
    """Name, names and identity of each loaded library's module and of each class in it."""
    class_ids: set[int] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that are deprecated
        for name, module in list(sys.modules.items()):
            if (
                type(module) is not types.ModuleType
                or name == "__main__"
                or not is_library_module(module)
            ):
                continue
            yield name, vars(module), module
            for key, value in list(vars(module).items()):
                if (
                    type(value) is not types.FunctionType
                    and isinstance(value, type)
                    and id(value) not in class_ids
                ):
                    class_ids.add(id(value))
                    yield f"{name}.{key}", vars(value), value


def _has_no_module(value: Any) -> bool:
    """Whether a function was executed in a namespace without a name."""
    return type(value) is types.FunctionType and "__name__" not in value.__globals__


def _own_function(value: Any) -> Any:
    """Somebody's own function that a name of a library leads to; None for what libraries are made
    of."""
    kind = type(value)
    if kind is types.FunctionType:
        return None if _is_quickly_library(value) else value
    if kind is types.MethodType or kind is staticmethod or kind is classmethod:
        return _own_function(value.__func__)
    if kind is functools.partial:
        return _own_function(value.func)
    if kind is functools._lru_cache_wrapper:
        return _own_function(value.__wrapped__)
    if kind is property:
        return next(
            (own for f in (value.fget, value.fset) if (own := _own_function(f)) is not None),
            None,
        )
    return None


_known_libraries: dict[int, Any] = {}
"""Identity of the namespace of a library's module -> the namespace, kept so that its identity stays
its own."""


def _is_quickly_library(function: types.FunctionType) -> bool:
    names = function.__globals__
    if id(names) in _known_libraries:
        return True
    # by collections, for every class
    is_made_here = (names.get("__name__") or "").startswith("namedtuple_")
    if is_made_here or is_library_code(function) or is_made_by_library(function):
        _known_libraries[id(names)] = names
        return True
    return False
