"""Which implementation of an operation runs: the plain torch reference, or a fast kernel.

An operation is declared once, by putting ``@op`` on its reference; fast versions are named below as strings and
imported on first use. Nothing else in the package imports ``gsfusion_nb.kernels``.
"""

import contextlib
import dataclasses
import functools
import importlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar

import torch

from .checks import check_name

log = logging.getLogger(__name__)

BACKENDS = ("reference", "numba", "triton", "cuda")

_NUMBA = "gsfusion_nb.kernels.numba"
_TRITON = "gsfusion_nb.kernels.triton"
_CUDA = "gsfusion_nb.kernels.cuda"

PROVIDERS: dict[str, dict[str, str]] = {
    "adam_update": {"numba": f"{_NUMBA}.adam:adam_update", "triton": f"{_TRITON}.adam:adam_update"},
    "band_blocks": {
        "numba": f"{_NUMBA}.allocate:band_blocks",
        "triton": f"{_TRITON}.allocate:band_blocks",
        "cuda": f"{_CUDA}.allocate:band_blocks",
    },
    "disc_depth": {"numba": f"{_NUMBA}.disc:disc_depth", "triton": f"{_TRITON}.disc:disc_depth"},
    "disc_depth_vjp": {"numba": f"{_NUMBA}.disc:disc_depth_vjp", "triton": f"{_TRITON}.disc:disc_depth_vjp"},
    "extract_mesh": {
        "numba": f"{_NUMBA}.marching_cubes:extract_mesh",
        "cuda": f"{_CUDA}.marching_cubes:extract_mesh",
    },
    "fuse_frame_": {
        "numba": f"{_NUMBA}.integrate:fuse_frame_",
        "triton": f"{_TRITON}.integrate:fuse_frame_",
        "cuda": f"{_CUDA}.integrate:fuse_frame_",
    },
    "icp_system": {"numba": f"{_NUMBA}.icp:icp_system", "triton": f"{_TRITON}.icp:icp_system"},
    "l1_mse_vjp": {"numba": f"{_NUMBA}.l1_loss:l1_mse_vjp", "triton": f"{_TRITON}.l1_loss:l1_mse_vjp"},
    "quadtree": {"numba": f"{_NUMBA}.quadtree:quadtree", "cuda": f"{_CUDA}.quadtree:quadtree"},
    "rgbd_l1_vjp": {"numba": f"{_NUMBA}.rgbd_loss:rgbd_l1_vjp", "triton": f"{_TRITON}.rgbd_loss:rgbd_l1_vjp"},
    "sample_voxels": {"numba": f"{_NUMBA}.sample:sample_voxels", "triton": f"{_TRITON}.sample:sample_voxels"},
    "raycast": {"numba": f"{_NUMBA}.raycast:raycast", "triton": f"{_TRITON}.raycast:raycast"},
    "dssim_vjp": {"numba": f"{_NUMBA}.ssim:dssim_vjp", "triton": f"{_TRITON}.ssim:dssim_vjp"},
    "render_forward": {
        "numba": f"{_NUMBA}.rasterize:render_forward",
        "triton": f"{_TRITON}.rasterize:render_forward",
        "cuda": f"{_CUDA}.rasterize:render_forward",
    },
    "render_vjp": {
        "numba": f"{_NUMBA}.rasterize:render_vjp",
        "triton": f"{_TRITON}.rasterize:render_vjp",
        "cuda": f"{_CUDA}.rasterize:render_vjp",
    },
}
"""op name -> backend -> "module:function"."""

_EMULATED_BY = {"triton": "TRITON_INTERPRET", "cuda": "GSFUSION_CUDA_EMULATOR"}
"""Backend for GPUs -> environment variable that lets it run on the processor, for tests."""

_PREFERRED = {"cpu": ("numba",), "cuda": ("cuda", "triton")}


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


def op(reference: Callable) -> Callable:
    """Make ``reference`` an operation that fast versions may stand in for; ``f.reference`` is always the original."""
    name = reference.__name__
    _OPS[name] = reference

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

    dispatch.reference = reference  # pyright: ignore[reportAttributeAccessIssue]
    return dispatch


@functools.cache
def load(name: str, backend: str) -> Callable:
    """The function that ``backend`` offers for operation ``name``.

    Raises:
        BackendUnavailable: with the reason, if that backend has none or cannot be imported.
    """
    check_name("operation", name, _OPS)
    check_name("backend", backend, BACKENDS)
    if backend == "reference":
        return _OPS[name]
    provider = PROVIDERS.get(name, {}).get(backend)
    if provider is None:
        raise BackendUnavailable(f"{name}: backend {backend!r} has no implementation of it")
    if backend in _EMULATED_BY and not (torch.cuda.is_available() or os.environ.get(_EMULATED_BY[backend])):
        # before the import: triton's LLVM and that of VTK's software renderer end the process when both are loaded
        raise BackendUnavailable(f"{name}: backend {backend!r} needs an NVIDIA GPU, and torch sees none")
    module, function = provider.split(":")
    try:
        return getattr(importlib.import_module(module), function)
    except ModuleNotFoundError as e:
        raise BackendUnavailable(f"{name}: backend {backend!r} needs {e.name!r}, which is not installed") from None
    except ImportError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which cannot be imported ({e})"
        ) from None


@contextlib.contextmanager
def use_backend(backend: str) -> Iterator[None]:
    """Run operations on ``backend`` inside the block: "auto", "reference", "numba", "triton" or "cuda".

    With a name other than "auto", an operation that the backend lacks raises ``BackendUnavailable``.
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
        for backend in ("reference", *PROVIDERS.get(name, {})):
            try:
                load(name, backend)
                rows.append((name, backend, "ok"))
            except BackendUnavailable as e:
                rows.append((name, backend, str(e)))
    return rows


def _chosen() -> str:
    return _choice.get() or _FROM_ENVIRONMENT


def _select(name: str, args: tuple, kwargs: dict) -> Callable:
    choice = _chosen()
    if choice != "auto":
        check_name("backend", choice, ("auto", *BACKENDS))
        return load(name, choice)
    offered = PROVIDERS.get(name)
    if not offered:
        return _OPS[name]
    device = next((kind for kind in _devices((*args, *kwargs.values())) if kind != "cpu"), "cpu")
    for backend in _PREFERRED.get(device, ()):
        if backend not in offered or backend in _set_aside:
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
