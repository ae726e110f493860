"""NumPy arrays of what a rule may only read cannot be written to."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..code_keys.origin import is_library_namespace

_local = threading.local()
_patching = threading.RLock()


@contextlib.contextmanager
def read_only(tensors: Iterable[tuple[str, Tensor]]) -> Iterator[list[str]]:
    """Context in which somebody's own code gets read-only arrays of these tensors, and of all views
    of them.

    ``numpy()``, ``np.asarray`` and ``memoryview`` share a tensor's memory, and torch does not count
    what is written there. Code of libraries, and of this package, gets arrays as usual.

    Args:
        tensors: Name and tensor of each.

    Yields:
        The names of which arrays were made, in their order.
    """
    places = {_storage(tensor): name for name, tensor in tensors if tensor.device.type == "cpu"}
    outer_state = getattr(_local, "places", {}), getattr(_local, "array_names", [])
    array_names: list[str] = []
    with _array_hooks():
        _local.places = places
        _local.array_names = array_names
        try:
            yield array_names
        finally:
            _local.places, _local.array_names = outer_state


@contextlib.contextmanager
def _array_hooks() -> Iterator[None]:
    kind: Any = Tensor
    with _patching:
        originals = {name: getattr(kind, name) for name in ("numpy", "__array__", "__dlpack__")}
        for name, function in originals.items():
            setattr(kind, name, _guard(function))
        try:
            yield
        finally:
            for name, function in originals.items():
                setattr(kind, name, function)


def _guard(function: Callable[..., Any]) -> Callable[..., Any]:
    def array(tensor: Tensor, *arguments: Any, **options: Any) -> Any:
        name = getattr(_local, "places", {}).get(_storage(tensor))
        if name is None or is_library_namespace(sys._getframe(1).f_globals):
            return function(tensor, *arguments, **options)
        if function.__name__ == "__dlpack__":  # which has no word for an array that is only read
            return function(tensor.clone(), *arguments, **options)
        result = function(tensor, *arguments, **options)
        if not _shares(result, tensor):
            return result
        _local.array_names.append(name)
        result = result.view()
        result.flags.writeable = False
        return result

    return array


def _shares(array: np.ndarray, tensor: Tensor) -> bool:
    """Whether an array is no copy."""
    first = tensor.untyped_storage().data_ptr()
    return (
        first <= array.__array_interface__["data"][0] <= first + tensor.untyped_storage().nbytes()
    )


def _storage(tensor: Tensor) -> int:
    return (
        0
        if tensor.layout is not torch.strided or tensor.is_meta
        else tensor.untyped_storage().data_ptr()
    )
