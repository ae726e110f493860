"""A hash of a value and of everything that decides what it does, equal in every process: code,
closures, attributes.

What a value consists of is what the pickle protocol says, with the additions of cloudpickle, so no
kind of value is left out. What cannot be pickled cannot be hashed.
"""

import functools
import io
import types
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from .digest import ATOMS, Digest, UnhashableError
from .names import words_of
from .objects import add_by_name, add_reduced
from .programs import add_class, add_code, add_function, add_module

_DESCRIPTORS = (
    types.MemberDescriptorType,
    types.GetSetDescriptorType,
    types.WrapperDescriptorType,
    types.MethodDescriptorType,
    types.ClassMethodDescriptorType,
)


class ValueHash(Digest):
    """Puts values into a hash. The same values give the same hash in every process.

    Own functions and classes are hashed with their code and with what the code can reach by the
    names in it. Those of libraries are hashed by their name.
    """

    def hexdigest(self) -> str:
        """The hash of all values so far."""
        self._settle()
        return super().hexdigest()

    def _settle(self) -> None:
        """Add what own code names anywhere of the own modules that it has, in whatever way it got
        the module."""
        n_names = -1
        while n_names != (n_names := sum(len(names) for names in self.names_at.values())):
            for module in sorted(self.modules.values(), key=lambda module: module.__name__):
                if module.__name__ != "__main__":  # a notebook has names of all kinds
                    add_module(self, module, self.words)

    def add(self, value: Any, place: str = "") -> None:
        """Add a value; ``place`` says where it is, for the message if it cannot be hashed.

        Raises:
            UnhashableError: it cannot be hashed.
        """
        if place:
            self.enter(place)
        try:
            self._add(value)
        except RecursionError:
            raise UnhashableError(f"{self.where()} is nested too deeply") from None
        if place:
            self.leave()

    def _add(self, x: Any) -> None:
        kind = type(x)
        self.text(kind.__qualname__)
        if kind in ATOMS:
            self.text(repr(x))
            if kind is str:
                self.words |= words_of(x)
        elif kind is tuple:
            self.add_all(x)
        elif kind is frozenset or kind is set:
            self._set(x)
        elif kind is types.CodeType:
            add_code(self, x)
        elif isinstance(x, types.ModuleType):
            add_module(self, x)
        elif kind in _DESCRIPTORS:
            self.text(f"{x.__qualname__}")
        elif self.is_new(x):
            self._object(x)

    def _object(self, x: Any) -> None:
        if hasattr(x, "cache_clear"):
            self.caches.append(x)
        if isinstance(x, types.FunctionType):
            add_function(self, x)
        elif isinstance(x, type):
            add_class(self, x)
        elif isinstance(x, torch.Tensor):
            self._tensor(x)
        elif type(x) is np.ndarray and not x.dtype.hasobject:
            self.text(f"{x.dtype.descr} {x.shape} {x.strides}")
            self.data(np.ascontiguousarray(x).tobytes())
        elif type(x) is list:
            self.add_all(x)
        elif type(x) is dict:
            self.add_mapping(x)
        elif isinstance(x, types.MappingProxyType):
            self.add_mapping(dict(x))
        elif isinstance(x, io.IOBase):
            self.give_up(x, "it is open")
        elif not self._wrapper(x) and not add_by_name(self, x):
            add_reduced(self, x)

    def _wrapper(self, x: Any) -> bool:
        """Whether an object only stands around functions; if so, these are added."""
        if isinstance(x, property):
            self.add_all((x.fget, x.fset, x.fdel))
        elif isinstance(x, classmethod | staticmethod):
            self.add(x.__func__)
        elif isinstance(x, types.MethodType):
            self.add_all((x.__self__, x.__func__))
        elif isinstance(x, types.MethodWrapperType):
            self.add_all((x.__self__, x.__name__))
        elif isinstance(x, functools.cached_property):
            self.add_all((x.func, x.attrname))
        elif isinstance(x, functools._lru_cache_wrapper):
            self.text(repr(x.cache_parameters()))
            self.add(x.__wrapped__)
        elif isinstance(source_function := getattr(x, "py_func", None), types.FunctionType):
            # compiled by numba
            self.text(repr(sorted(getattr(x, "targetoptions", {}).items())))
            self.add(source_function)
        else:
            return False
        return True

    def _set(self, x: Iterable[Any]) -> None:
        """Items in the order of their hashes: that of a set differs from process to process."""
        self.walks_sets = True
        digests = []
        for item in x:
            item_hash = ValueHash(self.strict)
            item_hash.add(item)
            self.merge(item_hash)
            digests.append(item_hash.hexdigest())
        self.text(" ".join(sorted(digests)))

    def _tensor(self, x: torch.Tensor) -> None:
        if x.layout is not torch.strided or x.is_quantized or x.is_meta:
            add_reduced(self, x)
            return
        self.text(f"{x.dtype} {tuple(x.shape)} {x.stride()} {x.requires_grad} {x.device.type}")
        plain = x.detach().cpu().resolve_conj().resolve_neg().contiguous()
        flat = plain.view(-1)
        # one value of a column counts as contiguous, and cannot be seen as bytes
        if flat.stride(0) != 1:
            flat = flat.clone(memory_format=torch.contiguous_format)
        self.data(flat.view(torch.uint8).numpy().tobytes())
        if type(x) not in (torch.Tensor, torch.nn.Parameter):
            self.add(type(x))
        self.add_attributes(getattr(x, "__dict__", {}))
        if x.is_leaf and x.grad is not None:
            self.add(x.grad, ".grad")
