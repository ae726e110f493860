"""Tensors that say they are on a GPU and compute on the processor.

What fails on a GPU fails here: an operation on tensors of two devices, a generator of the other device, a value read as
if it were in the host's memory. What makes the host wait is counted by place, and so is what would be launched.
"""

import collections
import ctypes
import traceback
from pathlib import Path

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

GPU = torch.device("cuda:0")
ROOT = Path(__file__).resolve().parents[3]
OURS = tuple(f"{ROOT / folder}/" for folder in ("gsfusion_nb", "kernels"))

_WAITING = {"_local_scalar_dense", "nonzero", "unique_consecutive", "_unique2", "unique_dim", "masked_select", "equal"}
_INDEXING = {"index", "index_put_", "_index_put_impl_"}
_COPYING = {"copy_", "_to_copy"}


class Tally:
    """What happened on the device since the last ``clear``."""

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        self.launches = 0
        self.waits: collections.Counter[tuple[str, str]] = collections.Counter()
        """(what for, folder/file:line of the package) -> times."""

    def wait(self, reason: str) -> None:
        frames = [f for f in traceback.extract_stack() if f.filename.startswith(OURS)]
        place = f"{'/'.join(Path(frames[-1].filename).parts[-2:])}:{frames[-1].lineno}" if frames else ""
        self.waits[reason, place] += 1

    @property
    def n_waits(self) -> int:
        return sum(self.waits.values())


tally = Tally()


class OnGpu(Tensor):
    """A tensor on ``GPU`` whose values are in ``inner``."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor):
        shape = torch.empty_strided(inner.size(), inner.stride(), dtype=inner.dtype, device="meta")
        out = torch.Tensor._make_subclass(cls, shape, False, dispatch_device=True)  # pyright: ignore[reportAttributeAccessIssue]
        out.inner = inner
        return out

    def __init__(self, inner: Tensor):
        super().__init__()

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"OnGpu({self.inner!r})"

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _inside(value):
    return tree_map_only(OnGpu, lambda t: t.inner, value)


def _outside(value):
    return tree_map_only(Tensor, lambda t: t if isinstance(t, OnGpu) else OnGpu(t), value)


def _is_gpu(device) -> bool:
    return device is not None and not isinstance(device, Tensor) and torch.device(device).type == "cuda"


def _run(func, args, kwargs):
    """An operation below the level of Python's functions; one without any tensor on the GPU is none of ours."""
    if func is torch.ops.prim.device.default:
        return GPU
    name, tensors = func._schema.name.split("::")[1], []
    tree_map_only(Tensor, tensors.append, (args, kwargs))
    if not any(isinstance(t, OnGpu) for t in tensors):
        if not _is_gpu(kwargs.get("device")):
            return func(*args, **kwargs)
        tally.launches += 1
        return OnGpu(func(*args, **{**kwargs, "device": torch.device("cpu")}))
    _refuse_mixtures(func, name, tensors)
    _count_waits(name, args, kwargs)
    device = kwargs.get("device")
    if device is not None and not _is_gpu(device):
        if name != "_to_copy":
            raise RuntimeError(f"{func}: tensors on {GPU}, wanted on {device}")
        return func(*_inside(args), **kwargs).clone()
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    arguments = func._schema.arguments
    if not any(a.alias_info is not None and not a.alias_info.is_write for a in arguments):  # a view launches nothing
        tally.launches += 1
    out = func(*_inside(args), **_inside(kwargs))
    written = [kwargs[a.name] if a.kwarg_only else value for a, value in _written(arguments, args, kwargs)]
    return written[0] if written and isinstance(out, Tensor) else _outside(out)


def _written(arguments, args, kwargs):
    values = [*args, *(None for _ in arguments[len(args) :])]
    for argument, value in zip(arguments, values, strict=True):
        is_written = argument.alias_info is not None and argument.alias_info.is_write
        if is_written and (not argument.kwarg_only or argument.name in kwargs):
            yield argument, value


def _refuse_mixtures(func, name: str, tensors: list[Tensor]) -> None:
    for t in tensors:
        if isinstance(t, OnGpu) or t.ndim == 0 or name in _COPYING:
            continue
        if name in _INDEXING and t.dtype in (torch.int64, torch.bool, torch.uint8):
            tally.wait("indices from the processor")
            continue
        raise RuntimeError(f"{func}: expected all tensors on {GPU}, got one on the cpu of shape {list(t.shape)}")


def _count_waits(name: str, args, kwargs) -> None:
    if name in _WAITING or (name == "repeat_interleave" and kwargs.get("output_size") is None):
        tally.wait(name)
    if name in _INDEXING:
        fills = name != "index" and args[2].numel() == 1
        for i in args[1]:
            if i is not None and i.dtype in (torch.bool, torch.uint8) and not fills:
                tally.wait(f"{name} with a mask")
    if name == "copy_" and isinstance(args[0], OnGpu) != isinstance(args[1], OnGpu):
        tally.wait("copy between devices")
    if name == "_to_copy" and kwargs.get("device") is not None and not _is_gpu(kwargs["device"]):
        tally.wait("copy to the processor")


class Below(TorchDispatchMode):
    """Operations on nothing but sizes and a device."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class Above(TorchFunctionMode):
    """Python's functions that would look for CUDA before anything else."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        on_gpu = bool(args) and isinstance(args[0], OnGpu)
        if func is Tensor.tolist and on_gpu:
            tally.wait("tolist")
            return args[0].inner.tolist()
        if func is Tensor.cpu and on_gpu:
            tally.wait("copy to the processor")
            return args[0].inner.clone()
        if func is Tensor.to:
            return _move(func, args, kwargs)
        if func is Tensor.new_tensor and on_gpu:
            tally.wait("copy to the GPU")
            return OnGpu(args[0].inner.new_tensor(*args[1:], **kwargs))
        if _is_gpu(kwargs.get("device")) and not on_gpu:
            if kwargs.get("generator") is not None:
                raise RuntimeError(f"{func}: expected a generator on {GPU}, got one on the cpu")
            if func in (torch.tensor, torch.as_tensor):
                tally.wait("copy to the GPU")
            tally.launches += 1
            return OnGpu(func(*args, **{**kwargs, "device": "cpu"}))
        return func(*args, **kwargs)


def _move(func, args, kwargs):
    """``tensor.to(device or dtype or tensor)``."""
    source, wanted = args[0], [*args[1:], kwargs.get("device"), kwargs.get("dtype")]
    like = [w for w in wanted if isinstance(w, Tensor)]
    devices = [t.device for t in like] + [torch.device(w) for w in wanted if isinstance(w, (str, torch.device))]
    dtypes = [t.dtype for t in like] + [w for w in wanted if isinstance(w, torch.dtype)]
    inner = source.inner if isinstance(source, OnGpu) else source
    dtype = dtypes[0] if dtypes else inner.dtype
    to_gpu = devices[0].type == "cuda" if devices else isinstance(source, OnGpu)
    if to_gpu != isinstance(source, OnGpu):
        tally.wait("copy to the GPU" if to_gpu else "copy to the processor")
        moved = inner.to(dtype).clone()
        return OnGpu(moved) if to_gpu else moved
    if not to_gpu:
        return func(*args, **kwargs)
    if dtype == inner.dtype:
        return source
    tally.launches += 1
    return OnGpu(inner.to(dtype))


def lend_a_guard() -> None:
    """Torch's builds for the processor have no object that switches CUDA devices: that of the meta device does."""
    c10 = ctypes.CDLL(str(next((Path(torch.__file__).parent / "lib").glob("libc10.*"))))
    guards = (ctypes.c_void_p * 32).in_dll(c10, "_ZN3c104impl26device_guard_impl_registryE")
    cuda, meta = 1, 14  # c10/core/DeviceType.h
    if not guards[meta]:
        raise RuntimeError("torch keeps its device guards elsewhere")
    guards[cuda] = guards[meta]
