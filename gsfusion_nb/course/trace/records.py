"""What a trace holds of one operation: references to the tensors that the program made, and copies of those that it
changes afterwards; all of it within a limit of memory."""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
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
    T_WC: Float[Tensor, "4 4"]
    target: Tensor
    """The photograph, bytes or 0..1. [H, W, 3]"""
    ids: Int[Tensor, " R"]
    """Identity of each Gaussian that was rendered."""
    rows: Int[Tensor, " R"] | None
    """Its row in the map; ``None``: 0, 1, 2, ..."""
    screen: ScreenGaussians
    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    hit_index: Int[Tensor, "H W"] | None
    """Row (of what was rendered) of the disc that each pixel hits, or -1."""
    disc_depth_m: Float[Tensor, "H W"] | None
    v_rgb: Float[Tensor, "H W 3"]
    """dL/d of the picture."""
    loss: Float[Tensor, ""]
    adam: dict[str, AdamColumn]
    """Parameter -> its step. The rows are the first ones of what was rendered."""
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
    asked_xyz_W: Float[Tensor, "M 3"] | None
    """Points whose voxels the rule looked up last."""
    asked_W: Float[Tensor, " M"] | None
    asked_D: Float[Tensor, " M"] | None
    seeds: Seeds


@dataclass(frozen=True, kw_only=True, eq=False)
class StateRecord(Record):
    """States of a map of discs before and after they were managed."""

    ids: Int[Tensor, " N"]
    before: dict[str, Tensor]
    """Column -> value of each row. [N] each"""
    ids_after: Int[Tensor, " M"]
    after: dict[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class PastRecord(Record):
    """Fusion of the optimised values with those before the window."""

    ids: Int[Tensor, " R"]
    confidence_before: Int[Tensor, " R"]
    confidence_after: Int[Tensor, " R"]
    before: dict[str, Tensor]
    optimised: dict[str, Tensor]
    fused: dict[str, Tensor]


class HeldRecords:
    """The newest records. When they hold more than ``limit_bytes``, the oldest is given to ``leaves`` and dropped.

    A tensor that several records share is counted once. The newest record is always held.
    """

    def __init__(self, limit_bytes: int, leaves: Callable[[Record], None]):
        self.limit_bytes, self._leaves = limit_bytes, leaves
        self._records: deque[Record] = deque()
        self._users: dict[int, list[int]] = {}
        """Address of a storage -> [records that hold it, bytes]."""
        self.n_dropped = 0

    def __iter__(self) -> Iterator[Record]:
        return iter(tuple(self._records))

    def __len__(self) -> int:
        return len(self._records)

    @property
    def memory_bytes(self) -> int:
        """Memory of the tensors that are held, bytes."""
        return sum(size for _, size in self._users.values())

    def add(self, record: Record) -> None:
        """Hold a record."""
        self._records.append(record)
        for address, size in _storages(record).items():
            self._users.setdefault(address, [0, size])[0] += 1
        while self.memory_bytes > self.limit_bytes and len(self._records) > 1:
            self._leaves(self._records[0])
            self._forget(self._records.popleft())
            self.n_dropped += 1

    def cut(self, serial: int) -> None:
        """Forget the records from ``serial`` on."""
        while self._records and self._records[-1].serial >= serial:
            self._forget(self._records.pop())

    def _forget(self, record: Record) -> None:
        for address in _storages(record):
            self._users[address][0] -= 1
            if not self._users[address][0]:
                del self._users[address]


def _storages(record: Record) -> dict[int, int]:
    def storage(tensor: Tensor) -> tuple[int, int]:
        held = tensor.untyped_storage()
        return held.data_ptr(), held.nbytes()

    return dict(storage(tensor) for tensor in record.tensors() if tensor.numel())
