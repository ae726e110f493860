"""Groups of kernel arguments: a ``NamedTuple`` here is a struct of the same name and fields in the CUDA source.

A field is a number of 32 bits, or the address of a tensor, unless its annotation says what it is, for example
``Annotated[float, ctypes.c_double]`` or ``Annotated[list[float], ctypes.c_float * 9]``. A test compares every group
with its source.

How the arguments of a kernel lie in memory is worked out at its first launch; after that they are packed in one go,
because making an object of ``ctypes`` for each costs the host more than starting the kernel.
"""

import ctypes
import functools
import struct
import types
from collections.abc import Sequence
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from torch import Tensor

_NUMBERS = {bool: ctypes.c_int, int: ctypes.c_int, float: ctypes.c_float}
_CODES = {ctypes.c_void_p: "Q", ctypes.c_int: "i", ctypes.c_float: "f", ctypes.c_double: "d", ctypes.c_longlong: "q"}


def is_group(arg: Any) -> bool:
    """Whether an argument is a group of others."""
    return isinstance(arg, tuple) and hasattr(arg, "_fields")


@functools.cache
def layout(group: type) -> type[ctypes.Structure]:
    """The struct of a class of groups."""
    hints = get_type_hints(group, include_extras=True)
    return type(group.__name__, (ctypes.Structure,), {"_fields_": [(name, _c_type(h)) for name, h in hints.items()]})


class Arguments:
    """How the arguments of one kernel lie in memory: as the members of a struct.

    Args:
        example: The arguments of a launch; those of later ones are of the same kinds.
    """

    def __init__(self, example: Sequence[Any]):
        kinds = [layout(type(arg)) if is_group(arg) else _c_type_of(arg) for arg in example]
        everything = type("Everything", (ctypes.Structure,), {"_fields_": [(f"_{i}", k) for i, k in enumerate(kinds)]})
        self._offsets = [getattr(everything, f"_{i}").offset for i in range(len(kinds))]
        text, end = "=", 0
        for offset, code, size in _leaves(everything, 0):
            text, end = f"{text}{offset - end}x{code}", offset + size
        self._format = struct.Struct(text)
        self._pointers = ctypes.c_void_p * len(kinds)
        self._groups = [is_group(arg) for arg in example]
        members: list[Any] = []
        for kind, grouped in zip(kinds, self._groups, strict=True):
            members += [field[1] for field in kind._fields_] if grouped else [kind]
        self._tensors = [i for i, kind in enumerate(members) if kind is ctypes.c_void_p]
        self._arrays = [i for i, kind in enumerate(members) if issubclass(kind, ctypes.Array)]
        self._wrapped = [i for i, value in enumerate(self.flat(example)) if isinstance(value, ctypes._SimpleCData)]

    def flat(self, args: Sequence[Any]) -> list[Any]:
        """The arguments, those in groups one after another."""
        flat: list[Any] = []
        for arg, grouped in zip(args, self._groups, strict=True):
            if grouped:
                flat += arg
            else:
                flat.append(arg)
        return flat

    def pack(self, operation: str, values: list[Any]) -> tuple[Any, Any]:
        """The addresses of the packed arguments, which are valid as long as the second result lives. ``values``: from
        ``flat``; they are overwritten.

        Raises:
            ValueError: a tensor has gaps, or a number does not fit in 32 bits.
        """
        for i in self._tensors:
            values[i] = _address(operation, values[i])
        for i in self._wrapped:
            values[i] = values[i].value
        for i in reversed(self._arrays):
            values[i : i + 1] = values[i]
        try:
            packed = ctypes.create_string_buffer(self._format.pack(*values), self._format.size)
        except (struct.error, OverflowError) as e:
            raise ValueError(f"{operation}: a number does not fit in the kernel's 32 bits ({e})") from None
        start = ctypes.addressof(packed)
        return self._pointers(*[start + offset for offset in self._offsets]), packed


def _address(operation: str, tensor: Tensor | None) -> int:
    """Where the values of a tensor are; the null pointer for ``None``."""
    if tensor is None:
        return 0
    if not tensor.is_contiguous():
        raise ValueError(f"{operation}: tensors without gaps were expected, got strides {tensor.stride()}")
    return tensor.data_ptr()


def _leaves(kind: Any, start: int) -> list[tuple[int, str, int]]:
    """Offset, code of ``struct`` and bytes of every number and address inside a type, in order."""
    if issubclass(kind, ctypes.Structure):
        fields = [(getattr(kind, name).offset, k) for name, k in kind._fields_]  # pyright: ignore[reportAssignmentType]
        return [leaf for offset, k in fields for leaf in _leaves(k, start + offset)]
    if issubclass(kind, ctypes.Array):
        array: Any = kind
        number, count = array._type_, array._length_
        return [leaf for i in range(count) for leaf in _leaves(number, start + i * ctypes.sizeof(number))]
    return [(start, _CODES[kind], ctypes.sizeof(kind))]


def _c_type_of(arg: Any) -> Any:
    if arg is None or isinstance(arg, Tensor):
        return ctypes.c_void_p
    return type(arg) if isinstance(arg, ctypes._SimpleCData) else _NUMBERS[float if isinstance(arg, float) else int]


def _c_type(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return get_args(hint)[1]
    choices = get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    return ctypes.c_void_p if Tensor in choices else _NUMBERS[hint]
