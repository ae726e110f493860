"""What a kernel is given, as its source says: its parameters, and the fields of the structs among
them.

How they lie in memory is worked out at a kernel's first launch; after that they are packed in one
go, because making an object of ``ctypes`` for each costs the host more than starting the kernel.
"""

import ctypes
import functools
import re
import struct
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from .nvrtc import KERNELS

_NUMBERS = {"int": ctypes.c_int, "float": ctypes.c_float, "double": ctypes.c_double}
_CODES = {ctypes.c_void_p: "Q", ctypes.c_int: "i", ctypes.c_float: "f", ctypes.c_double: "d"}


class Signature:
    """The parameters of one kernel, which lie in memory like the members of a struct.

    Args:
        stem: Of ``<stem>.cu``.
        kernel: Name of the kernel in it.
    """

    def __init__(self, stem: str, kernel: str):
        text = _source(f"{stem}.cu")
        (parameters,) = re.findall(
            rf"__global__ void [^;{{]*?{kernel}\((.*?)\) \{{", text, re.DOTALL
        )
        declarations = _declared(text, parameters.replace(",", ";"))
        everything: Any = type("Everything", (ctypes.Structure,), {"_fields_": declarations})
        self._offsets = [getattr(everything, name).offset for name, _ in declarations]
        self._groups = [
            [field[0] for field in getattr(kind, "_fields_", ())] for _, kind in declarations
        ]
        layout = "="
        end = 0
        for offset, code, size in _leaves(everything, 0):
            layout = f"{layout}{offset - end}x{code}"
            end = offset + size
        self._format = struct.Struct(layout)
        self._pointers = ctypes.c_void_p * len(declarations)

    def flat(self, args: Sequence[Any]) -> list[Any]:
        """The arguments, those of structs one after another."""
        flat: list[Any] = []
        for arg, fields in zip(args, self._groups, strict=True):
            if fields:
                flat += [arg[name] for name in fields]
            else:
                flat.append(arg)
        return flat

    def pack(self, operation: str, values: list[Any]) -> tuple[Any, Any]:
        """The addresses of the packed arguments, valid as long as the second result lives.
        ``values``: from ``flat``.

        Raises:
            ValueError: a tensor has gaps, or a number does not fit in its bits.
        """
        numbers: list[Any] = []
        for value in values:
            if value is None:
                numbers.append(0)
            elif isinstance(value, Tensor):
                if not value.is_contiguous():
                    raise ValueError(
                        f"{operation}: tensors without gaps were expected, got strides "
                        f"{value.stride()}"
                    )
                numbers.append(value.data_ptr())
            elif isinstance(value, (list, tuple)):
                numbers += value
            else:
                numbers.append(value)
        try:
            buffer = ctypes.create_string_buffer(self._format.pack(*numbers), self._format.size)
        except (struct.error, OverflowError) as e:
            raise ValueError(
                f"{operation}: a number does not fit in the kernel's parameter ({e})"
            ) from None
        start = ctypes.addressof(buffer)
        return self._pointers(*[start + offset for offset in self._offsets]), buffer


def _source(name: str) -> str:
    """A source and all that it includes, without comments."""
    (path,) = KERNELS.glob(f"*/{name}")
    text = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
    return text + "".join(
        _source(header) for header in dict.fromkeys(re.findall(r'#include "(.+?)"', text))
    )


def _declared(text: str, declarations: str) -> list[tuple[str, Any]]:
    """Name and type of each variable in declarations such as
    ``const float *D, *W; int size[3]``."""
    found = []
    for declaration in filter(str.strip, declarations.split(";")):
        found_type = re.match(
            r"\s*(?:const )?((?:(?:un)?signed )?(?:long long|\w+))(.*)", declaration, re.DOTALL
        )
        assert found_type is not None
        kind, names = found_type.groups()
        for part in names.split(","):
            star, name, length = re.findall(r"(\**)\s*(\w+)(?:\[(\d+)\])?\s*$", part)[0]
            number = ctypes.c_void_p if star else _NUMBERS.get(kind) or _struct(text, kind)
            found.append((name, number * int(length) if length else number))
    return found


def _struct(text: str, name: str) -> type[ctypes.Structure]:
    """The struct of this name in a source."""
    (body, *_) = re.findall(rf"struct {name} \{{(.*?)\}};", text, re.DOTALL)
    return type(name, (ctypes.Structure,), {"_fields_": _declared(text, body)})


def _leaves(kind: Any, start: int) -> list[tuple[int, str, int]]:
    """Offset, code of ``struct`` and bytes of every number and address inside a type, in order."""
    if issubclass(kind, ctypes.Structure):
        fields = [(getattr(kind, name).offset, k) for name, k in kind._fields_]  # pyright: ignore[reportAssignmentType]
        return [leaf for offset, k in fields for leaf in _leaves(k, start + offset)]
    if issubclass(kind, ctypes.Array):
        array: Any = kind
        size = ctypes.sizeof(array._type_)
        return [
            leaf for i in range(array._length_) for leaf in _leaves(array._type_, start + i * size)
        ]
    return [(start, _CODES[kind], ctypes.sizeof(kind))]


signature = functools.cache(Signature)
"""That of a kernel, read once."""
