"""Torch as a map needs it, whatever mode and default the caller has set."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, ParamSpec, TypeVar

import torch

from ..types import Frame

P = ParamSpec("P")
R = TypeVar("R")


@contextlib.contextmanager
def usual_torch() -> Iterator[None]:
    """New tensors inside the block are float32, and can be changed in place later.

    Tensors made in ``torch.inference_mode`` cannot be changed outside of it, so a map that grew
    partly inside would take no more frames. With ``torch.set_default_dtype(torch.float64)`` its
    columns would differ from its pictures.
    """
    given = torch.get_default_dtype()
    with torch.inference_mode(False):
        if given == torch.float32:
            yield
            return
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(given)


def in_usual_torch(function: Callable[P, R]) -> Callable[P, R]:
    """The function, run in ``usual_torch``."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with usual_torch():
            return function(*args, **kwargs)

    return run


class InUsualTorch:
    """What a class and its subclasses offer to callers runs in ``usual_torch``: the methods that
    ``_OFFERS`` names."""

    _OFFERS: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **rest: Any):
        super().__init_subclass__(**rest)
        for name in cls._OFFERS:
            if name in vars(cls):
                setattr(cls, name, in_usual_torch(vars(cls)[name]))


def changeable(frame: Frame) -> Frame:
    """The frame with tensors that can be kept in a map: copies, if it was made in
    ``torch.inference_mode``."""
    values = {"colour": frame.colour, "depth_m": frame.depth_m, "T_WC": frame.T_WC}
    if not any(value.is_inference() for value in (*values.values(), *frame.extra.values())):
        return frame
    copies = {name: value.clone() for name, value in values.items()}
    return dataclasses.replace(
        frame,
        **copies,
        extra={name: value.clone() for name, value in frame.extra.items()},
    )
