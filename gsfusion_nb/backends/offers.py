"""Which backends an operation has, which of them can run here, and which is the fastest.

A backend's function is found by the name of its file, ``<package>/<backend>.py``, and imported on
first use. ``numba`` (CPU), ``triton`` and ``cuda`` (NVIDIA GPUs) are compiled, for float32.
"""

import functools
import importlib
import importlib.resources
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import torch

from ..checks import check_name
from ..errors import ForeseenError
from . import registry

BACKENDS = ("reference", "numba", "triton", "cuda")

EMULATED_BY = {"triton": "TRITON_INTERPRET", "cuda": "GSFUSION_CUDA_EMULATOR"}
"""Backend for GPUs -> environment variable that lets it run on the processor, for tests."""

PREFERRED = {"cpu": ("numba",), "cuda": ("cuda", "triton")}
"""Kind of device -> backends that take its tensors, the fastest first. On any other device the
reference runs."""


TRITON_FROM = (8, 0)
"""Compute capability from which on Triton supports an NVIDIA GPU; "auto" passes it over on older
ones. AMD's GPUs count in another way."""


class BackendUnavailable(ForeseenError, RuntimeError):
    """A backend was asked for by name and cannot run; the message says what is missing."""


def operations() -> tuple[str, ...]:
    """Names of the operations that some backend besides the reference offers, among those declared
    so far."""
    return tuple(sorted(name for name in registry.OPERATIONS if offered(name)))


@functools.cache
def offered(name: str) -> tuple[str, ...]:
    """Backends, besides the reference, that have a module for operation ``name``; one may lack what
    it runs on."""
    check_name("operation", name, registry.OPERATIONS)
    try:
        package = importlib.import_module(registry.FOLDERS[name])
    except ModuleNotFoundError:
        return ()
    files = {path.stem for folder in package.__path__ for path in Path(folder).glob("*.py")}
    return tuple(b for b in BACKENDS[1:] if b in files and _defines(package, b, name))


def _defines(package: ModuleType, backend: str, name: str) -> bool:
    """Whether the backend's module has a function ``name``, read without importing it."""
    source = (
        importlib.resources.files(package).joinpath(f"{backend}.py").read_text(encoding="utf-8")
    )
    return re.search(rf"^def {name}\(", source, re.MULTILINE) is not None


@functools.cache
def load(name: str, backend: str) -> Callable:
    """The function that ``backend`` offers for operation ``name``.

    Raises:
        BackendUnavailable: with the reason, if that backend has none or cannot be imported.
    """
    check_name("operation", name, registry.OPERATIONS)
    check_name("backend", backend, BACKENDS)
    if backend == "reference":
        return registry.OPERATIONS[name]
    if backend not in offered(name):
        raise BackendUnavailable(f"{name}: backend {backend!r} has no implementation of it")
    if backend in EMULATED_BY and not (
        torch.cuda.is_available() or os.environ.get(EMULATED_BY[backend])
    ):
        # before the import: triton's LLVM and that of VTK's software renderer end the process when
        # both are loaded
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs an NVIDIA GPU, and torch sees none"
        )
    try:
        return getattr(importlib.import_module(f"{registry.FOLDERS[name]}.{backend}"), name)
    except ModuleNotFoundError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which is not installed"
        ) from None
    except ImportError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which cannot be imported ({e})"
        ) from None


@functools.cache
def problem_of(name: str, backend: str) -> str | None:
    """Why ``backend`` cannot run operation ``name`` here, or is not made for this GPU; or
    ``None``."""
    try:
        load(name, backend)
    except BackendUnavailable as e:
        return str(e)
    if backend != "triton" or torch.version.hip or not torch.cuda.is_available():
        return None
    capability = torch.cuda.get_device_capability()
    if capability >= TRITON_FROM:
        return None
    wanted, own = (".".join(map(str, version)) for version in (TRITON_FROM, capability))
    return (
        f"{name}: Triton supports GPUs of compute capability {wanted} and newer, and this one has "
        f"{own}"
    )


@functools.cache
def automatic(name: str, device: str) -> str:
    """The backend that "auto" takes for operation ``name`` and tensors on a kind of device ("cpu",
    "cuda", ...)."""
    for backend in PREFERRED.get(device, ()):
        if backend in offered(name) and problem_of(name, backend) is None:
            return backend
    return "reference"


def report() -> list[tuple[str, str, str]]:
    """Rows (operation, backend, "ok" or the reason it cannot run)."""
    return [
        (name, b, problem_of(name, b) or "ok")
        for name in sorted(registry.OPERATIONS)
        for b in ("reference", *offered(name))
    ]


def is_compiled(name: str) -> bool:
    """Whether the numba kernels of an operation are on disk already, or cannot run here, so that
    there is nothing to compile."""
    if problem_of(name, "numba") is not None:
        return True
    module = sys.modules[f"{registry.FOLDERS[name]}.numba"]
    has_saved = importlib.import_module(f"{registry.KERNELS}.runtime.numba.shared_cache").has_saved
    return any(has_saved(value) for value in vars(module).values() if hasattr(value, "py_func"))


def kernel_threads() -> tuple[str, Callable[[], None]]:
    """Whose threads the numba kernels run on ("tbb", "workqueue" or "omp"), and a kernel without
    work, to time."""
    launch = importlib.import_module(f"{registry.KERNELS}.runtime.numba.launch")
    return launch.threads_from(), launch.start_threads


def look_again() -> None:
    """Forget what was found out about backends, because files, packages or the environment have
    changed (tests)."""
    for function in (offered, load, automatic, problem_of):
        function.cache_clear()
