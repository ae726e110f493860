"""Which implementation of an operation runs: the plain reference, or a faster one.

An operation is declared once, by putting ``@op("folder")`` on its reference. Faster versions are
functions of the same name in ``kernels/<folder>/<backend>.py``; they are found by their file name
and imported on first use. Nothing else in the package imports ``gsfusion_nb.kernels``.

``numba`` (CPU), ``triton`` and ``cuda`` (NVIDIA GPUs) are compiled, for float32. Operations on
Gaussians in float64, and on tensors on other devices, run on the reference instead.

``mine`` is the reference with the functions of a learner in it (``FUNCTIONS``). They replace whole
operations, or the parts of an operation that are declared with ``@piece``. It exists only in a
Python session that has imported ``gsfusion_nb.course.learner_backend``.

An observer sees the calls of marked functions (``observed``, ``observing``). Nothing is watched by
default; a marked function then costs one look at a variable.
"""

import contextlib
import dataclasses
import functools
import importlib
import importlib.resources
import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import torch

from .checks import check_name
from .errors import ArgumentError, ForeseenError
from .interrupts import as_interrupt
from .types import GaussianParams

log = logging.getLogger(__name__)

BACKENDS = ("reference", "numba", "triton", "cuda")

MINE = "mine"
"""The backend that runs the functions of a learner."""

_KERNELS = f"{__package__}.kernels"
_FOLDERS: dict[str, str] = {}
"""Operation -> package of its kernels, which has a module per backend that offers it:
``<package>.<backend>``."""

_EMULATED_BY = {"triton": "TRITON_INTERPRET", "cuda": "GSFUSION_CUDA_EMULATOR"}
"""Backend for GPUs -> environment variable that lets it run on the processor, for tests."""

_PREFERRED = {"cpu": ("numba",), "cuda": ("cuda", "triton")}
"""Kind of device -> backends that take its tensors, the fastest first. On any other device the
reference runs."""


def backend_names() -> tuple[str, ...]:
    """What a command can be asked to run on; a Python session that has imported the course also has
    ``mine``."""
    return ("auto", *BACKENDS)


def from_environment() -> str:
    """What the variable GSFUSION_BACKEND asks for, else "auto"."""
    return os.environ.get("GSFUSION_BACKEND", "auto")


_OPS: dict[str, Callable] = {}
_PIECES: dict[str, Callable] = {}
_FROM_ENVIRONMENT = from_environment()
_choice: ContextVar[str | None] = ContextVar("gsfusion_backend", default=None)
_messages: set[tuple[str, str]] = set()


class BackendUnavailable(ForeseenError, RuntimeError):
    """A backend was asked for by name and cannot run; the message says what is missing."""


class Record:
    """What a forward operation keeps for its gradient. The gradient runs on the backend that made
    the record."""

    backend = "reference"
    """Subclasses in the kernels name theirs."""


def op(
    folder: str,
    check: Callable[..., None] | None = None,
) -> Callable[[Callable], Callable]:
    """Make a function the reference of an operation, whose faster versions are in
    ``kernels/<folder>``.

    ``check`` takes the arguments of the operation and raises ``ValueError`` for those that no
    backend can take; it runs before any of them does.

    ``f.reference`` is the function itself, and inside it every other operation is the reference
    too. An operation whose first argument is a ``Record`` runs on the backend that made the record,
    whatever backend is in use.
    """

    def declare(reference: Callable) -> Callable:
        name = reference.__name__
        _OPS[name] = reference
        _FOLDERS[name] = f"{_KERNELS}.{folder}"

        @observed
        @functools.wraps(reference)
        def dispatch(*args, **kwargs):
            if check is not None:
                try:
                    check(*args, **kwargs)
                except ValueError as e:
                    raise ArgumentError(f"{name}: {e}") from None
            if chosen() not in ("reference", MINE) and _is_double(args, kwargs):
                return plain(*args, **kwargs)
            try:
                return _select(name, args, kwargs)(*args, **kwargs)
            except SystemError as e:
                interrupt = as_interrupt(e)
                if interrupt is None:
                    raise
                raise interrupt from None

        @functools.wraps(reference)
        def plain(*args, **kwargs):
            with use_backend("reference"):
                return reference(*args, **kwargs)

        dispatch.reference = plain  # pyright: ignore[reportAttributeAccessIssue]
        return dispatch

    return declare


def piece(reference: Callable) -> Callable:
    """Declare a plain function as a part of an operation that a learner can replace: the backend
    ``mine`` runs theirs.

    On every other backend the function itself runs.
    """
    name = reference.__name__
    _PIECES[name] = reference

    @functools.wraps(reference)
    def dispatch(*args, **kwargs):
        if _choice.get() == MINE:
            return _run_counted(name, reference, args, kwargs)
        return reference(*args, **kwargs)

    return dispatch


def reference_of(name: str) -> Callable:
    """The plain function of an operation, or of a piece of one.

    Raises:
        UnknownNameError: there is none.
    """
    functions = _OPS | _PIECES
    check_name("operation", name, functions)
    return functions[name]


def operations() -> tuple[str, ...]:
    """Names of the operations that some backend besides the reference offers, among those declared
    so far."""
    return tuple(sorted(name for name in _OPS if offered(name)))


@functools.cache
def offered(name: str) -> tuple[str, ...]:
    """Backends, besides the reference, that have a module for operation ``name``; one may lack what
    it runs on."""
    check_name("operation", name, _OPS)
    try:
        package = importlib.import_module(_FOLDERS[name])
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
    check_name("operation", name, _OPS)
    check_name("backend", backend, BACKENDS)
    if backend == "reference":
        return _OPS[name]
    if backend not in offered(name):
        raise BackendUnavailable(f"{name}: backend {backend!r} has no implementation of it")
    if backend in _EMULATED_BY and not (
        torch.cuda.is_available() or os.environ.get(_EMULATED_BY[backend])
    ):
        # before the import: triton's LLVM and that of VTK's software renderer end the process when
        # both are loaded
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs an NVIDIA GPU, and torch sees none"
        )
    try:
        return getattr(importlib.import_module(f"{_FOLDERS[name]}.{backend}"), name)
    except ModuleNotFoundError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which is not installed"
        ) from None
    except ImportError as e:
        raise BackendUnavailable(
            f"{name}: backend {backend!r} needs {e.name!r}, which cannot be imported ({e})"
        ) from None


@contextlib.contextmanager
def use_backend(backend: str) -> Iterator[None]:
    """Run operations on ``backend`` inside the block: "auto", "reference", "numba", "triton",
    "cuda", "mine".

    With "numba", "triton" or "cuda", an operation that this backend does not offer runs on the
    reference. "mine" runs the functions that a learner wrote, and the reference for all other
    operations.

    Raises:
        BackendUnavailable: "mine" where the course is not imported, for instance on the command
            line.
    """
    check_name("backend", backend, (*backend_names(), MINE))
    if backend == MINE:
        _check_course()
    token = _choice.set(backend)
    try:
        yield
    finally:
        _choice.reset(token)


def runs_learners_code() -> bool:
    """Whether the backend is ``mine``, where any operation may fail because of a learner's
    function."""
    return chosen() == MINE


def look_again() -> None:
    """Forget what was found out about backends, because files, packages or the environment have
    changed (tests)."""
    for function in (offered, load, automatic, _problem):
        function.cache_clear()


def kernel_threads() -> tuple[str, Callable[[], None]]:
    """Whose threads the numba kernels run on ("tbb", "workqueue" or "omp"), and a kernel without
    work, to time."""
    launch = importlib.import_module(f"{_KERNELS}.runtime.numba.launch")
    return launch.threads_from(), launch.start_threads


def is_compiled(name: str) -> bool:
    """Whether the numba kernels of an operation are on disk already, or cannot run here, so that
    there is nothing to compile."""
    if _problem(name, "numba") is not None:
        return True
    module = sys.modules[f"{_FOLDERS[name]}.numba"]
    has_saved = importlib.import_module(f"{_KERNELS}.runtime.numba.shared_cache").has_saved
    return any(has_saved(value) for value in vars(module).values() if hasattr(value, "py_func"))


def report() -> list[tuple[str, str, str]]:
    """Rows (operation, backend, "ok" or the reason it cannot run)."""
    return [
        (name, b, _problem(name, b) or "ok")
        for name in sorted(_OPS)
        for b in ("reference", *offered(name))
    ]


@functools.cache
def automatic(name: str, device: str) -> str:
    """The backend that "auto" takes for operation ``name`` and tensors on a kind of device ("cpu",
    "cuda", ...)."""
    for backend in _PREFERRED.get(device, ()):
        if backend in offered(name) and _problem(name, backend) is None:
            return backend
    return "reference"


@functools.cache
def _problem(name: str, backend: str) -> str | None:
    """Why ``backend`` cannot run operation ``name`` here, or ``None``."""
    try:
        load(name, backend)
    except BackendUnavailable as e:
        return str(e)
    return None


def chosen() -> str:
    """The backend that was asked for: by ``use_backend``, else by the environment."""
    return _choice.get() or _FROM_ENVIRONMENT


def _select(name: str, args: tuple, kwargs: dict) -> Callable:
    if (
        args
        and isinstance(args[0], Record)
        and (args[0].backend != "reference" or chosen() != MINE)
    ):
        return load(name, args[0].backend)
    choice = chosen()
    if choice == MINE:
        _check_course()
        return lambda *args, **kwargs: _run_counted(name, _OPS[name], args, kwargs)
    if choice != "auto":
        check_name("backend", choice, ("auto", *BACKENDS))  # it may be from the environment
        return load(name, choice if choice in offered(name) else "reference")
    if not offered(name):
        return _OPS[name]
    device = next(
        (kind for kind in _devices((*args, *kwargs.values())) if kind != "cpu"),
        "cpu",
    )
    backend = automatic(name, device)
    if backend == "reference" and (device != "cpu" or set(_PREFERRED["cpu"]) & set(offered(name))):
        _log_once(logging.WARNING, name, _why_slow(name, device))
    else:
        _log_once(logging.INFO, name, f"{name}: {backend}")
    return load(name, backend)


def _check_course() -> None:
    """Raise ``BackendUnavailable`` unless this Python session can have functions of a learner."""
    if f"{__package__}.course.learner_backend" not in sys.modules:
        raise BackendUnavailable(
            f"backend {MINE!r} runs functions that a learner wrote in a notebook of the course, "
            "and this program has "
            "none; use it in a notebook, after `from gsfusion_nb.course import mine`"
        )


def _is_double(args: tuple, kwargs: dict) -> bool:
    """Whether the first argument is Gaussians in float64, which the compiled backends do not
    take."""
    first = next(iter((*args, *kwargs.values())), None)
    return isinstance(first, GaussianParams) and first.xyz_W.dtype != torch.float32


def _why_slow(name: str, device: str) -> str:
    """A sentence for the user of an operation whose faster versions cannot be used, with what to do
    about it."""
    candidates = [b for b in _PREFERRED.get(device, ()) if b in offered(name)]
    if problems := [problem for b in candidates if (problem := _problem(name, b))]:
        return (
            f"{'; '.join(problems)}; {name} runs on the slower reference: `gsfusion-nb doctor` "
            "says what to install"
        )
    devices = " and ".join(
        sorted({kind for kind, names in _PREFERRED.items() if set(names) & set(offered(name))})
    )
    return (
        f"{name} runs on the slower reference: its faster versions take {devices} tensors, and "
        f"these are on {device!r}"
    )


def _devices(values: Iterable) -> Iterator[str]:
    """Kinds of device of tensors, of volumes, and of what dataclasses hold."""
    for value in values:
        if isinstance(value, GaussianParams):  # its columns are on one device
            yield value.xyz_W.device.type
        elif isinstance(getattr(value, "device", None), torch.device):
            yield value.device.type
        elif dataclasses.is_dataclass(value):
            yield from _devices(vars(value).values())


def _log_once(level: int, name: str, message: str) -> None:
    if (name, message) not in _messages:
        _messages.add((name, message))
        log.log(level, message)


@dataclass
class Calls:
    """How one operation, or one piece of an operation, ran under the backend ``mine``."""

    own: int = 0
    """Calls that the learner's function answered."""
    reference: int = 0
    """Calls that the plain reference answered."""
    seconds: float = 0.0
    """Wall time of all calls, without the time of other operations that they called."""


FUNCTIONS: dict[str, Callable[..., Any]] = {}
"""Operation or piece -> the learner's function, with the arguments of the operation. A function
that returns ``NotImplemented`` leaves this call to the reference."""

CALLS: dict[str, Calls] = {}
"""Operation or piece -> its calls since the counts were last cleared."""

_thread = threading.local()


def _run_counted(
    name: str,
    reference: Callable[..., Any],
    args: tuple,
    kwargs: dict[str, Any],
) -> Any:
    """Call the learner's function for ``name``, or ``reference``, and count the call."""
    durations = _thread.__dict__.setdefault("seconds_of_called", [])
    durations.append(0.0)
    began = time.perf_counter()
    is_own = False
    try:
        own = FUNCTIONS.get(name)
        result = NotImplemented if own is None else own(*args, **kwargs)
        is_own = result is not NotImplemented
        return result if is_own else reference(*args, **kwargs)
    finally:
        took = time.perf_counter() - began
        of_called = durations.pop()
        if durations:
            durations[-1] += took
        calls = CALLS.setdefault(name, Calls())
        calls.own += is_own
        calls.reference += not is_own
        calls.seconds += took - of_called


F = TypeVar("F", bound=Callable[..., Any])

Observer = Callable[[str, Callable[..., Any], tuple[Any, ...], dict[str, Any]], Any]
"""``observer(name, f, args, kwargs)`` must return ``f(*args, **kwargs)``; it may look at arguments
and result before and after, and must not change them."""

_observer: ContextVar[Observer | None] = ContextVar("gsfusion_observer", default=None)


def observed(f: F) -> F:
    """Mark a function or method, so that an observer sees its calls under its qualified name, such
    as "Adam.step"."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        observer = _observer.get()
        return f(*args, **kwargs) if observer is None else observer(f.__qualname__, f, args, kwargs)

    return call  # pyright: ignore[reportReturnType]


@contextlib.contextmanager
def observing(observer: Observer | None) -> Iterator[None]:
    """Context in which ``observer`` sees the calls of marked functions in this thread; ``None``:
    nobody does."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


@contextlib.contextmanager
def also_observing(observer: Observer) -> Iterator[None]:
    """Context in which ``observer`` sees the calls, besides whoever sees them already."""
    outer = _observer.get()

    def both(name: str, f: Callable, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        def seen_by_outer(*args: Any, **kwargs: Any) -> Any:
            return f(*args, **kwargs) if outer is None else outer(name, f, args, kwargs)

        return observer(name, seen_by_outer, args, kwargs)

    with observing(both):
        yield
