"""Objects in a hash as pickle would store them, with the additions of cloudpickle."""

import pickle
import types
from collections.abc import Callable
from typing import Any

import cloudpickle

from .digest import Digest
from .names import named_in
from .origin import is_library

_REDUCERS = cloudpickle.Pickler.dispatch_table


def add_by_name(digest: Digest, x: Any) -> bool:
    """Whether an object of a library can be found by its name, and was hashed by it."""
    module = getattr(x, "__module__", None)
    name = getattr(x, "__qualname__", None) or getattr(x, "__name__", None)
    if isinstance(x, types.BuiltinFunctionType) and isinstance(x.__self__, types.ModuleType | type):
        digest.text(f"{getattr(x.__self__, '__name__', '')}.{x.__qualname__}")
        return True
    if not isinstance(module, str) or not isinstance(name, str) or not is_library(module):
        return False
    if named_in(module, name) is not x:
        return False
    digest.text(f"{module}.{name}")
    return True


def add_reduced(digest: Digest, x: Any) -> None:
    """An object as pickle would store it."""
    try:
        reducer: Callable[[Any], Any] | None = _REDUCERS.get(type(x))
        reduction = reducer(x) if reducer is not None else x.__reduce_ex__(4)
    except Exception as e:  # whatever the object's own method raises
        digest.give_up(x, str(e))
        return
    if isinstance(reduction, str):
        _add_named(digest, x, reduction)
    else:
        _add_parts(digest, reduction)
    if not is_library(type(x).__module__):
        digest.add_attributes(_own_attributes(x))  # also what its own __getstate__ leaves out


def _add_named(digest: Digest, x: Any, name: str) -> None:
    """An object that pickle would store by its name."""
    home = pickle.whichmodule(x, name)  # pyright: ignore[reportAttributeAccessIssue]
    digest.text(f"{home}.{name}")
    if is_library(type(x).__module__) and named_in(home, name) is not x:
        digest.give_up(x, f"it is not {home}.{name}")


def _add_parts(digest: Digest, reduction: tuple[Any, ...]) -> None:
    make, arguments, *rest = reduction
    digest.add_all((make, *arguments))
    state, items, pairs = [*rest[:3], None, None, None][:3]
    for part in state if isinstance(state, tuple) and len(state) == 2 else (state,):
        if type(part) is dict and all(type(key) is str for key in part):
            digest.add_attributes(part)
        else:
            digest.add(part)
    digest.add_all([] if items is None else list(items))
    for key, value in [] if pairs is None else list(pairs):
        digest.add_all((key, value))


def _own_attributes(x: Any) -> dict[str, Any]:
    """Attributes of an object of somebody's own class, in its ``__dict__`` and in slots."""
    attributes = dict(x.__dict__) if type(getattr(x, "__dict__", None)) is dict else {}
    for kind in type(x).__mro__:
        for name, member in vars(kind).items():
            if (
                isinstance(member, types.MemberDescriptorType)
                and not is_library(kind.__module__)
                and hasattr(x, name)
            ):
                attributes[name] = getattr(x, name)
    return attributes
