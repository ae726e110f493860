"""Where a module or function comes from: a library, whose version stands for it, or a file."""

import functools
import importlib.util
import sys
import types
from collections.abc import Mapping
from typing import Any

from .installed import is_installed

LOADED_SOURCE = "__loaded_source__"
"""Name in a module that was loaded for a rule's file: the source that was executed."""

RULE_SOURCE = "__rule_source__"
"""Name in the module of a rule's file itself: its source."""

BESIDE = "__beside__"
"""Name in a module that was loaded for a rule's file: the finder of the modules beside that
file."""

OWN_PACKAGE = __name__.partition(".")[0]
CHECKS_TYPES = "jaxtyping"
"""Beginning of the names of modules that put checks of types around functions, and change nothing
else."""
_TEXT_OF_ATTRS = "<attrs generated "
"""Beginning of the file names of methods that the package ``attrs`` writes."""
_homes: dict[int, types.ModuleType] = {}
"""Identity of the namespace of a module that is not in ``sys.modules`` -> the module."""


@functools.lru_cache(maxsize=4096)
def is_library(module: str) -> bool:
    """Whether a module is this package's, Python's or an installed one, rather than somebody's
    own."""
    if module == "__main__":  # a notebook, or a script
        return False
    top = module.partition(".")[0]
    if top in (OWN_PACKAGE, *sys.stdlib_module_names) or not module or top.startswith(CHECKS_TYPES):
        return True
    loaded_module = sys.modules.get(module) or sys.modules.get(top)
    if loaded_module is not None:
        return _is_library(loaded_module)
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return True
    if spec is None:  # made by ``exec``, as a notebook's cells are
        return False
    file = spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    return file is None or file == "built-in" or is_installed(file)


def _is_library(module: types.ModuleType) -> bool:
    """``is_library`` of a module that is loaded."""
    if hasattr(module, LOADED_SOURCE):
        return False
    places = [getattr(module, "__file__", None), *getattr(module, "__path__", ())]
    place = next((place for place in places if isinstance(place, str)), None)
    if place is None:
        # built in; one without a spec was made by a program
        return getattr(module, "__spec__", None) is not None
    return is_installed(place) or place.startswith("<frozen")


def is_library_module(module: types.ModuleType) -> bool:
    """Whether this module object is a library's; two modules may share a name."""
    name = getattr(module, "__name__", "")
    if name == "__main__":
        return False
    if name.startswith(CHECKS_TYPES):
        return True
    if (
        name.partition(".")[0] in (OWN_PACKAGE, *sys.stdlib_module_names)
        and sys.modules.get(name) is module
    ):
        return True
    return _is_library(module)


@functools.lru_cache(maxsize=65536)
def is_own_class(kind: type) -> bool:
    """Whether a class was written in a notebook, or in a file that is no library's."""
    if kind.__module__ == "__main__":
        return True
    home = sys.modules.get(kind.__module__)
    if not isinstance(home, types.ModuleType) or is_library_module(home):
        return False
    return bool(getattr(home, "__file__", None)) or hasattr(home, LOADED_SOURCE)


def is_library_code(function: types.FunctionType) -> bool:
    """Whether a function was written in a library: the module that it looks up its names in is
    one."""
    return is_library_namespace(function.__globals__)


def is_library_namespace(names: Mapping[str, Any]) -> bool:
    """Whether the names of a module are those of a library's; by its file, since two modules may
    share a name."""
    name = names.get("__name__") or "__main__"
    top = name.partition(".")[0]
    if name == "__main__" or LOADED_SOURCE in names:
        return False
    if top in (OWN_PACKAGE, *sys.stdlib_module_names) or top.startswith(CHECKS_TYPES):
        return True
    file = names.get("__file__")
    return is_installed(file) if isinstance(file, str) else is_library(name)


def is_made_by_library(function: types.FunctionType) -> bool:
    """Whether a library wrote the text of a function while it was imported, and executed it in a
    namespace without a name.

    The package ``attrs`` names the text so. With others, such as ``decorator``, all that the
    namespace leads to is of the library's module that the function says it belongs to.
    """
    names = function.__globals__
    if "__name__" in names:
        return False
    text = function.__code__.co_filename
    if text.startswith(_TEXT_OF_ATTRS):  # <attrs generated METHOD MODULE.CLASS>
        return is_library(text.rstrip(">").rpartition(" ")[2].rpartition(".")[0])
    home = sys.modules.get(function.__module__ or "")
    if not isinstance(home, types.ModuleType) or not is_library_module(home):
        return False
    used = [
        value for key, value in names.items() if key != "__builtins__" and value is not function
    ]
    return bool(used) and all(_is_of(home, value) for value in used)


def _is_of(module: types.ModuleType, value: Any) -> bool:
    """Whether a function or a class was defined in a module."""
    if type(value) is types.FunctionType:
        return value.__globals__ is vars(module)
    return isinstance(value, type) and vars(module).get(value.__name__) is value


def keep_home(module: types.ModuleType) -> None:
    """Note a module that functions come from and that is not in ``sys.modules`` by its name."""
    _homes[id(vars(module))] = module


def home_of(function: types.FunctionType) -> types.ModuleType | None:
    """The module in whose namespace a function looks up its names; None for a namespace that is no
    module's."""
    names = function.__globals__
    module = sys.modules.get(names.get("__name__") or "")
    if isinstance(module, types.ModuleType) and vars(module) is names:
        return module
    return _homes.get(id(names))
