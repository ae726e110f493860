"""What a trace holds of each operation.

A record holds references to the tensors that the program made, and copies of those that it changes
afterwards.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ...config import TsdfConfig
from ...render import ScreenGaussians
from ...types import Camera, Frame, Seeds

Voxel = tuple[int, int, int]
Box = tuple[int, int, int, int]
"""First column, first row, width, height; pixels of the image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Operation:
    """When it was."""

    serial: int
    """Number of the operation, rising."""
    frame_index: int | None
    """The frame that was being mapped; ``None`` in the passes after the scan."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AdamColumn:
    """One parameter in one step of Adam: of all Gaussians, [R, ...] each, or of one: xyz_W [3], sh
    [K, 3], ..."""

    before: Tensor
    gradient: Tensor
    """dL/d of the parameter."""
    m: tuple[Tensor, Tensor]
    """Running mean of the gradient, before and after."""
    v: tuple[Tensor, Tensor]
    """Running mean of its square, before and after."""
    after: Tensor
    lr: float | Tensor
    """Learning rate, in units of the parameter: one number, or one for each SH coefficient."""

    def of_row(self, r: int) -> "AdamColumn":
        """The step of one Gaussian."""
        value0, gradient, value1, m0, m1, v0, v1 = (
            x[r].detach().cpu().clone()
            for x in (self.before, self.gradient, self.after, *self.m, *self.v)
        )
        return AdamColumn(
            before=value0,
            gradient=gradient,
            after=value1,
            m=(m0, m1),
            v=(v0, v1),
            lr=self.lr,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StepRecord(Operation):
    """One optimisation step on one view: rendering, gradient, Adam."""

    stage: str
    """"frame", "keyframe" (another view), or "passes"."""
    view_index: int
    camera: Camera
    ids: Int[Tensor, " R"]
    """Identity of each Gaussian that was rendered."""
    rows: Int[Tensor, " R"]
    """Its row in the map."""
    screen: ScreenGaussians
    rgb: Float[Tensor, "H W 3"]
    loss: Float[Tensor, ""]
    adam: dict[str, AdamColumn]
    """Parameter -> its step."""
    t: int | Int[Tensor, " R"] | None
    """Step number of the bias correction; ``None``: no correction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionRecord(Operation):
    """One frame fused into the volume: the blocks that it may change, D and W before and after."""

    frame: Frame
    config: TsdfConfig
    coords: Int[Tensor, "B 3"]
    D: tuple[Float[Tensor, "B 512"], Float[Tensor, "B 512"]]
    W: tuple[Float[Tensor, "B 512"], Float[Tensor, "B 512"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class SeedingRecord(Operation):
    """One question to the seeding rule."""

    frame: Frame
    cells: Any
    """The quadtree, if the rule asked for it."""
    seeds: Seeds


Record = StepRecord | FusionRecord | SeedingRecord


def memory_of(records: Iterable[Record]) -> int:
    """Memory of the tensors that records hold, bytes; one that several share is counted once."""
    storages = (t.untyped_storage() for t in tensors_of(records) if t.numel())
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


def tensors_of(values: Iterable[Any]) -> Iterator[Tensor]:
    """Every tensor in values that may hold others."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, dict):
            yield from tensors_of(value.values())
        elif isinstance(value, tuple):
            yield from tensors_of(value)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from tensors_of(vars(value).values())
