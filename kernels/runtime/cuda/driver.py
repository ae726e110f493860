"""Loading compiled kernels and starting them through the CUDA driver, in the context and on the
stream of torch."""

import ctypes
import functools
import sys
import threading

import torch

from gsfusion_nb.backends import BackendUnavailable

from .nvrtc import compile_source

_OUT_OF_MEMORY = 2
Size = tuple[int, int]


@functools.cache
def library() -> ctypes.CDLL:
    """The driver.

    Raises:
        BackendUnavailable: none is installed.
    """
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        return ctypes.CDLL(name)
    except OSError:
        raise BackendUnavailable(
            f"backend 'cuda' needs NVIDIA's driver ({name}), which is not installed"
        ) from None


def start(
    operation: str,
    stem: str,
    kernel: str,
    grid: Size,
    block: int,
    device: torch.device,
    pointers: ctypes.Array,
) -> None:
    """Run a kernel of ``<stem>.cu`` on torch's current stream of ``device``; nothing waits for it.

    Args:
        operation: Named by errors.
        grid: Blocks along x and y.
        block: Threads of a block.
        pointers: Where each argument is.
    """
    driver = library()
    current = torch.cuda.current_device()
    index = current if device.index is None else device.index
    if index != current:
        with torch.cuda.device(index):
            start(operation, stem, kernel, grid, block, device, pointers)
        return
    _enter_context(operation, driver, index)
    function = _function(operation, stem, kernel, index)
    stream = ctypes.c_void_p(_stream(index))
    status = driver.cuLaunchKernel(function, *grid, 1, block, 1, 1, 0, stream, pointers, None)
    _check(operation, driver, status)


@functools.cache
def _function(operation: str, stem: str, kernel: str, index: int) -> ctypes.c_void_p:
    driver = library()
    function = ctypes.c_void_p()
    status = driver.cuModuleGetFunction(
        ctypes.byref(function), _module(operation, stem, index), kernel.encode()
    )
    _check(operation, driver, status)
    return function


@functools.cache
def _module(operation: str, stem: str, index: int) -> ctypes.c_void_p:
    driver = library()
    module = ctypes.c_void_p()
    image = compile_source(stem, torch.cuda.get_device_capability(index))
    status = driver.cuModuleLoadData(ctypes.byref(module), image)
    if status and status != _OUT_OF_MEMORY:
        raise BackendUnavailable(
            f"{operation}: {stem}.cu cannot be loaded: the driver says {_words(status)}"
        )
    _check(operation, driver, status)
    return module


def _stream(index: int) -> int:
    """Torch's current stream; its public ``current_stream`` makes an object at every call."""
    return torch._C._cuda_getCurrentRawStream(index)


_threads = threading.local()


def _enter_context(operation: str, driver: ctypes.CDLL, index: int) -> None:
    """Torch makes its context current in a thread when it first needs it there; a launch may come
    before."""
    if getattr(_threads, "device", None) == index:
        return
    context = ctypes.c_void_p()
    _check(operation, driver, driver.cuCtxGetCurrent(ctypes.byref(context)))
    if not context.value:
        torch.cuda.init()
        _check(
            operation,
            driver,
            driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), _device(index)),
        )
        _check(operation, driver, driver.cuCtxSetCurrent(context))
    _threads.device = index


def _device(index: int) -> int:
    device = ctypes.c_int()
    driver = library()
    _check("cuDeviceGet", driver, driver.cuDeviceGet(ctypes.byref(device), index))
    return device.value


def _check(operation: str, driver: ctypes.CDLL, status: int) -> None:
    if not status:
        return
    kind = torch.OutOfMemoryError if status == _OUT_OF_MEMORY else RuntimeError
    raise kind(f"{operation}: the CUDA driver says {_words(status)}")


def _words(status: int) -> str:
    text = ctypes.c_char_p()
    library().cuGetErrorString(status, ctypes.byref(text))
    return f"{(text.value or b'unknown error').decode()} (error {status})"
