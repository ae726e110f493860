"""How a kernel is handed to the CUDA driver, with a stand-in for the driver."""

import contextlib
import ctypes
import importlib
from types import SimpleNamespace

import pytest
import torch

from gsfusion_nb.backends import BackendUnavailable


class Driver:
    """Remembers what it is asked; every call gives ``status``."""

    def __init__(self):
        self.calls, self.launched, self.status, self.has_context = [], None, 0, False

    def __getattr__(self, name):
        def call(*args):
            self.calls.append(name)
            return self.status

        return call

    def cuCtxGetCurrent(self, context):
        ctypes.cast(context, ctypes.POINTER(ctypes.c_void_p))[0] = 5 if self.has_context else None
        return 0

    def cuGetErrorString(self, status, text):
        ctypes.cast(text, ctypes.POINTER(ctypes.c_char_p))[0] = b"an illegal address"
        return 0

    def cuLaunchKernel(self, function, *args):
        *size, stream, values, extra = args
        number = ctypes.cast(values[1], ctypes.POINTER(ctypes.c_int))[0]
        real = ctypes.cast(values[2], ctypes.POINTER(ctypes.c_float))[0]
        address = ctypes.cast(values[0], ctypes.POINTER(ctypes.c_void_p))[0]
        self.launched = (size, stream.value, address, number, real, extra)
        return self.status


@pytest.fixture
def stand_in(monkeypatch):
    module, stand_in = importlib.import_module("gsfusion_nb.kernels.runtime.cuda.driver"), Driver()
    monkeypatch.setattr(module, "library", lambda: stand_in)
    monkeypatch.setattr(module, "compile_source", lambda stem, capability: b"machine code")
    monkeypatch.setattr(torch.cuda, "device", lambda index: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(module, "_stream", lambda index: 7)
    monkeypatch.setattr(module, "_threads", SimpleNamespace())
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, 0))
    module._module.cache_clear()
    module._function.cache_clear()
    yield module, stand_in
    module._module.cache_clear()
    module._function.cache_clear()


def start(module):
    values = [ctypes.c_void_p(1234), ctypes.c_int(-3), ctypes.c_float(0.5)]
    pointers = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
    module.start("op", "binning", "count_tiles", (10, 2), 128, torch.device("cuda", 0), pointers)


def test_arguments_grid_and_stream(stand_in):
    module, driver = stand_in
    start(module)
    assert driver.launched == ([10, 2, 1, 128, 1, 1, 0], 7, 1234, -3, 0.5, None)
    assert driver.calls == [
        "cuDeviceGet",
        "cuDevicePrimaryCtxRetain",
        "cuCtxSetCurrent",
        "cuModuleLoadData",
        "cuModuleGetFunction",
    ]
    driver.has_context = True
    start(module)
    assert len(driver.calls) == 5, "neither the context nor the module is made again"


def test_errors_name_the_operation(stand_in):
    module, driver = stand_in
    start(module)
    driver.has_context, driver.status = True, 700
    with pytest.raises(RuntimeError, match=r"op: the CUDA driver says an illegal address \(error 700\)"):
        start(module)
    driver.status = 2
    with pytest.raises(torch.OutOfMemoryError, match="op: the CUDA driver says"):
        start(module)


def test_without_a_driver_it_says_so(monkeypatch):
    module = importlib.import_module("gsfusion_nb.kernels.runtime.cuda.driver")

    def missing(name):
        raise OSError(name)

    monkeypatch.setattr(module.ctypes, "CDLL", missing)
    module.library.cache_clear()
    with pytest.raises(BackendUnavailable, match=r"'cuda' needs NVIDIA's driver \(.*\), which is not installed"):
        module.library()
    module.library.cache_clear()
