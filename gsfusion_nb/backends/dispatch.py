"""Declaring an operation, and running each of its calls on the backend in use."""

import dataclasses
import functools
import logging
from collections.abc import Callable, Iterable, Iterator

import torch

from ..checks import check_name
from ..errors import ArgumentError
from ..interrupts import as_interrupt
from ..types import Camera, GaussianParams
from . import registry
from .choice import choice_of_block, chosen, use_backend
from .learner import MINE, check_course, run_counted
from .observers import observed
from .offers import BACKENDS, PREFERRED, automatic, load, offered, problem_of

log = logging.getLogger(__name__)

_messages: set[tuple[str, str]] = set()
"""Operation and sentence of what was logged: each is said once."""


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
        registry.OPERATIONS[name] = reference
        registry.FOLDERS[name] = f"{registry.KERNELS}.{folder}"

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
                return _implementation(name, args, kwargs)(*args, **kwargs)
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
    registry.PIECES[name] = reference

    @functools.wraps(reference)
    def dispatch(*args, **kwargs):
        if choice_of_block.get() == MINE:
            return run_counted(name, reference, args, kwargs)
        return reference(*args, **kwargs)

    return dispatch


def _implementation(name: str, args: tuple, kwargs: dict) -> Callable:
    """The function that runs this call of operation ``name``."""
    if (
        args
        and isinstance(args[0], Record)
        and (args[0].backend != "reference" or chosen() != MINE)
    ):
        return load(name, args[0].backend)
    choice = chosen()
    if choice == MINE:
        check_course()
        return lambda *args, **kwargs: run_counted(name, registry.OPERATIONS[name], args, kwargs)
    if choice != "auto":
        check_name("backend", choice, ("auto", *BACKENDS))  # it may be from the environment
        if choice in offered(name):
            return load(name, choice)
        if choice != "reference":
            _say_what_is_missing(name, choice, args, kwargs)
        return load(name, "reference")
    if not offered(name):
        return registry.OPERATIONS[name]
    device = _device(args, kwargs)
    backend = automatic(name, device)
    if backend == "reference" and (device != "cpu" or set(PREFERRED["cpu"]) & set(offered(name))):
        _log_once(logging.WARNING, name, _why_slow(name, device))
    else:
        _log_once(logging.INFO, name, f"{name}: {backend}")
    return load(name, backend)


def _say_what_is_missing(name: str, choice: str, args: tuple, kwargs: dict) -> None:
    """Warn that the backend that was asked for does not offer an operation that another one offers
    on the same device."""
    if not offered(name):
        return
    device = _device(args, kwargs)
    others = [b for b in PREFERRED.get(device, ()) if b in offered(name)]
    if others:
        _log_once(
            logging.WARNING,
            name,
            f"backend {choice!r} has no {name}, which runs on the slower reference; "
            f"{' and '.join(others)} would have it",
        )


def _is_double(args: tuple, kwargs: dict) -> bool:
    """Whether the first argument is Gaussians in float64, which the compiled backends do not
    take."""
    first = next(iter((*args, *kwargs.values())), None)
    return isinstance(first, GaussianParams) and first.xyz_W.dtype != torch.float32


def _why_slow(name: str, device: str) -> str:
    """A sentence for the user of an operation whose faster versions cannot be used, with what to do
    about it."""
    candidates = [b for b in PREFERRED.get(device, ()) if b in offered(name)]
    if problems := [problem for b in candidates if (problem := problem_of(name, b))]:
        return (
            f"{'; '.join(problems)}; {name} runs on the slower reference: `gsfusion-nb doctor` "
            "says what to install"
        )
    devices = " and ".join(
        sorted({kind for kind, names in PREFERRED.items() if set(names) & set(offered(name))})
    )
    return (
        f"{name} runs on the slower reference: its faster versions take {devices} tensors, and "
        f"these are on {device!r}"
    )


def _device(args: tuple, kwargs: dict) -> str:
    """The kind of device of a call: that of its tensors, of which small ones may be on the CPU."""
    return next((kind for kind in _devices((*args, *kwargs.values())) if kind != "cpu"), "cpu")


_WITHOUT_DEVICE = (Camera, float, int, str, type(None))


def _devices(values: Iterable) -> Iterator[str]:
    """Kinds of device of tensors, of volumes, and of what dataclasses hold."""
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value.device.type
        elif isinstance(value, _WITHOUT_DEVICE):  # most arguments; to look into them takes longer
            continue
        elif isinstance(value, GaussianParams):  # its columns are on one device
            yield value.xyz_W.device.type
        elif isinstance(getattr(value, "device", None), torch.device):
            yield value.device.type
        elif dataclasses.is_dataclass(value):
            yield from _devices(vars(value).values())


def _log_once(level: int, name: str, message: str) -> None:
    if (name, message) not in _messages:
        _messages.add((name, message))
        log.log(level, message)
