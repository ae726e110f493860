"""Groups of kernel arguments: a ``NamedTuple`` here is a struct of the same name and fields in the CUDA source.

A field is a number of 32 bits, or the address of a tensor, unless its annotation says what it is, for example
``Annotated[float, ctypes.c_double]`` or ``Annotated[list[float], ctypes.c_float * 9]``. A test compares every group
with its source.
"""

import ctypes
import functools
import types
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from torch import Tensor

_NUMBERS = {bool: ctypes.c_int, int: ctypes.c_int, float: ctypes.c_float}


def is_group(arg: Any) -> bool:
    """Whether an argument is a group of others."""
    return isinstance(arg, tuple) and hasattr(arg, "_fields")


@functools.cache
def layout(group: type) -> type[ctypes.Structure]:
    """The struct of a class of groups."""
    hints = get_type_hints(group, include_extras=True)
    return type(group.__name__, (ctypes.Structure,), {"_fields_": [(name, _c_type(h)) for name, h in hints.items()]})


def to_struct(operation: str, group: Any) -> ctypes.Structure:
    """The struct with the values of a group.

    Raises:
        ValueError: a tensor has gaps.
    """
    struct, arrays = _parts(type(group))
    values = [address(operation, value) if isinstance(value, Tensor) else value for value in group]
    for i, kind in arrays:
        values[i] = kind(*values[i])
    return struct(*values)


@functools.cache
def _parts(group: type) -> tuple[type[ctypes.Structure], list[tuple[int, Any]]]:
    """The struct, and place and type of those of its fields that are arrays of numbers."""
    fields = enumerate(layout(group)._fields_)  # pyright: ignore[reportArgumentType]
    return layout(group), [(i, kind) for i, (_, kind) in fields if issubclass(kind, ctypes.Array)]


def address(operation: str, tensor: Tensor | None) -> int | None:
    """Where the values of a tensor are; the null pointer for ``None``.

    Raises:
        ValueError: it has gaps.
    """
    if tensor is None:
        return None
    if not tensor.is_contiguous():
        raise ValueError(f"{operation}: tensors without gaps were expected, got strides {tensor.stride()}")
    return tensor.data_ptr()


def _c_type(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return get_args(hint)[1]
    choices = get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    return ctypes.c_void_p if Tensor in choices else _NUMBERS[hint]
