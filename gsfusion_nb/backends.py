"""Which implementation of an operation runs: the plain reference, or a faster one.

An operation is declared once, by putting ``@op("folder")`` on its reference. Faster versions are functions of the same
name in ``kernels/<folder>/<backend>.py``; they are found by their file name and imported on first use. Nothing else in
the package imports ``gsfusion_nb.kernels``.
"""

import contextlib
import dataclasses
import functools
import importlib
import importlib.resources
import logging
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from .checks import check_name

log = logging.getLogger(__name__)

BACKENDS = ("reference", "torch", "numba", "triton", "cuda")

_KERNELS = f"{__package__}.kernels"
_FOLDERS: dict[str, str] = {}
"""Operation -> package of its kernels, which has a module per backend that offers it: ``<package>.<backend>``."""

_EMULATED_BY = {"triton": "TRITON_INTERPRET", "cuda": "GSFUSION_CUDA_EMULATOR"}
"""Backend for GPUs -> environment variable that lets it run on the processor, for tests."""

_PREFERRED = {"cpu": ("numba", "torch"), "cuda": ("cuda", "triton", "torch")}


def from_environment() -> str:
    """What the variable GSFUSION_BACKEND asks for, else "auto"."""
    return os.environ.get("GSFUSION_BACKEND", "auto")


_OPS: dict[str, Callable] = {}
_FROM_ENVIRONMENT = from_environment()
_choice: ContextVar[str | None] = ContextVar("gsfusion_backend", default=None)
_logged: set[tuple[str, str]] = set()
_set_aside: set[str] = set()


class BackendUnavailable(RuntimeError):
    """A backend was asked for by name and cannot run; the message says what is missing."""


class KernelsUnusable(BackendUnavailable):
    """Kernels turned out at their first use not to run here, before they changed anything.

    Args:
        backend: Its name; "auto" goes on without it, for all operations, for what one has made another cannot take.
        reason: A sentence.
    """

    def __init__(self, backend: str, reason: str):
        super().__init__(reason)
        self.backend = backend


class Record:
    """What a forward operation keeps for its gradient. The gradient runs on the backend that made the record."""

    backend = "reference"
    """Subclasses in the kernels name theirs."""


def op(folder: str) -> Callable[[Callable], Callable]:
    """Make a reference an operation that the kernels in ``kernels/<folder>`` may stand in for.

    ``f.reference`` is always the original, and inside it every other operation is the reference too. An operation whose
    first argument is a ``Record`` runs on the backend that made the record, whatever backend is in use.
    """

    def declare(reference: Callable) -> Callable:
        name = reference.__name__
        _OPS[name] = reference
        _FOLDERS[name] = f"{_KERNELS}.{folder}"

        @functools.wraps(reference)
        def dispatch(*args, **kwargs):
            while True:
                implementation = _select(name, args, kwargs)
                try:
                    return implementation(*args, **kwargs)
                except KernelsUnusable as e:
                    if _chosen() != "auto" or e.backend in _set_aside:
                        raise
                    _set_aside.add(e.backend)
                    log.warning("backend %r is set aside: %s", e.backend, e)

        @functools.wraps(reference)
        def plain(*args, **kwargs):
            with use_backend("reference"):
                return reference(*args, **kwargs)

        dispatch.reference = plain  # pyright: ignore[reportAttributeAccessIssue]
        return dispatch

    return declare


def operations() -> tuple[str, ...]:
    """Names of the operations that some backend besides the reference offers; those declared so far."""
    return tuple(sorted(name for name in _OPS if offered(name)))


@functools.cache
def offered(name: str) -> tuple[str, ...]:
    """Backends, besides the reference, that have a module for operation ``name``; one may lack what it runs on."""
    check_name("operation", name, _OPS)
    try:
        package = importlib.import_module(_FOLDERS[name])
    except ModuleNotFoundError:
        return ()
    files = {path.stem for folder in package.__path__ for path in Path(folder).glob("*.py")}
    return tuple(b for b in BACKENDS[1:] if b in files and _defines(package, b, name))


def cases() -> Iterator[Any]:
    """Every ``Case`` of every operation's folder (``kernels/<folder>/cases.py``), for parity tests and warm-up."""
    root = importlib.import_module(_KERNELS)
    for path in sorted(path for folder in root.__path__ for path in Path(folder).glob("*/cases.py")):
        if path.parent.name != "runtime":
            yield from importlib.import_module(f"{_KERNELS}.{path.parent.name}.cases").cases()


def _defines(package: ModuleType, backend: str, name: str) -> bool:
    """Whether the backend's module has a function ``name``, read without importing it."""
    source = importlib.resources.files(package).joinpath(f"{backend}.py").read_text(encoding="utf-8")
    return re.search(rf"^def {name}\(", source, re.MULTILINE) is not None


@functools.cache
def load(name: str, backend: str) -> Callable:
    """The function that ``backend`` offers for operation ``name``.

    Where the reference is fast enough already there is no torch version: "torch" then gives the reference.

    Raises:
        BackendUnavailable: with the reason, if that backend has none or cannot be imported.
    """
    check_name("operation", name, _OPS)
    check_name("backend", backend, BACKENDS)
    if backend == "reference" or (backend == "torch" and "torch" not in offered(name)):
        return _OPS[name]
    if backend not in offered(name):
        raise BackendUnavailable(f"{name}: backend {backend!r} has no implementation of it")
    if backend in _EMULATED_BY and not (torch.cuda.is_available() or os.environ.get(_EMULATED_BY[backend])):
        # before the import: triton's LLVM and that of VTK's software renderer end the process when both are loaded
        raise BackendUnavailable(f"{name}: backend {backend!r} needs an NVIDIA GPU, and torch sees none")
    try:
        return getattr(importlib.import_module(f"{_FOLDERS[name]}.{backend}"), name)
    except ModuleNotFoundError as e:
        raise BackendUnavailable(f"{name}: backend {backend!r} needs {e.name!r}, which is not installed") from None
    except ImportError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which cannot be imported ({e})"
        ) from None


@contextlib.contextmanager
def use_backend(backend: str) -> Iterator[None]:
    """Run operations on ``backend`` inside the block: "auto", "reference", "torch", "numba", "triton" or "cuda".

    With a name other than "auto", an operation that the backend lacks raises ``BackendUnavailable``; only "torch" runs
    the reference there.
    """
    check_name("backend", backend, ("auto", *BACKENDS))
    token = _choice.set(backend)
    try:
        yield
    finally:
        _choice.reset(token)


def report() -> list[tuple[str, str, str]]:
    """Rows (operation, backend, "ok" or the reason it cannot run)."""
    rows = []
    for name in sorted(_OPS):
        for backend in ("reference", *offered(name)):
            try:
                load(name, backend)
                rows.append((name, backend, "ok"))
            except BackendUnavailable as e:
                rows.append((name, backend, str(e)))
    return rows


def _chosen() -> str:
    return _choice.get() or _FROM_ENVIRONMENT


def _select(name: str, args: tuple, kwargs: dict) -> Callable:
    if args and isinstance(args[0], Record):
        return load(name, args[0].backend)
    choice = _chosen()
    if choice != "auto":
        check_name("backend", choice, ("auto", *BACKENDS))
        return load(name, choice)
    available = offered(name)
    if not available:
        return _OPS[name]
    device = next((kind for kind in _devices((*args, *kwargs.values())) if kind != "cpu"), "cpu")
    for backend in _PREFERRED.get(device, ()):
        if backend not in available or backend in _set_aside:
            continue
        try:
            implementation = load(name, backend)
        except BackendUnavailable as e:
            _log_once(name, f"{e}; using the reference")
            continue
        _log_once(name, f"{name}: {backend}")
        return implementation
    return _OPS[name]


def _devices(values: Iterable) -> Iterator[str]:
    """Kinds of device of tensors, of volumes, and of what dataclasses hold."""
    for value in values:
        if isinstance(getattr(value, "device", None), torch.device):
            yield value.device.type
        elif dataclasses.is_dataclass(value):
            yield from _devices(vars(value).values())


def _log_once(name: str, message: str) -> None:
    if (name, message) not in _logged:
        _logged.add((name, message))
        log.info(message)
