"""What a trace holds of one operation: references to the tensors that the program made, and copies of those that it
changes afterwards; all of it within a limit of memory."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ...config import TsdfConfig
from ...render import ScreenGaussians
from ...seeding import Cells
from ...types import Camera, Frame, Seeds


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """One operation."""

    serial: int
    """Number of the operation, rising."""
    frame_index: int | None
    """The frame that was being mapped; ``None`` in the passes after the scan."""

    def tensors(self) -> Iterator[Tensor]:
        """Every tensor that is held."""
        yield from _tensors_of(vars(self).values())


def _tensors_of(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, dict):
            yield from _tensors_of(value.values())
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from _tensors_of(vars(value).values())


@dataclass(frozen=True, kw_only=True, eq=False)
class AdamColumn:
    """One column of parameters in one step of Adam, before and after. [R, ...] each"""

    before: Tensor
    gradient: Tensor
    m_before: Tensor
    v_before: Tensor
    after: Tensor
    m_after: Tensor
    v_after: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class StepRecord(Record):
    """One optimisation step on one view: rendering, gradient, Adam."""

    stage: str
    """"frame", "keyframe" (another view), or "passes"."""
    view_index: int
    camera: Camera
    target: Tensor
    """The photograph, bytes or 0..1. [H, W, 3]"""
    ids: Int[Tensor, " R"]
    """Identity of each Gaussian that was rendered."""
    rows: Int[Tensor, " R"]
    """Its row in the map."""
    screen: ScreenGaussians
    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    v_rgb: Float[Tensor, "H W 3"]
    """dL/d of the picture."""
    loss: Float[Tensor, ""]
    adam: dict[str, AdamColumn]
    """Parameter -> its step."""
    t: int | Int[Tensor, " R"] | None
    """Step number of the bias correction; ``None``: no correction."""
    rates: dict[str, Any]
    """Parameter -> learning rate, one number or one for each SH coefficient."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionRecord(Record):
    """One frame fused into the volume: the blocks that it may change, before and after."""

    frame: Frame
    config: TsdfConfig
    coords: Int[Tensor, "B 3"]
    D_before: Float[Tensor, "B 512"]
    W_before: Float[Tensor, "B 512"]
    D_after: Float[Tensor, "B 512"]
    W_after: Float[Tensor, "B 512"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SeedingRecord(Record):
    """One question to the seeding rule."""

    frame: Frame
    rule: str
    cells: Cells | None
    """The quadtree, if the rule asked for it."""
    seeds: Seeds


def memory_of(records: Iterable[Record]) -> int:
    """Memory of the tensors that records hold, bytes; one that several share is counted once."""
    storages = (t.untyped_storage() for record in records for t in record.tensors() if t.numel())
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())
