"""Follow a Gaussian or a voxel through everything that a mapper does to it."""

import contextlib
import dataclasses
from collections import deque
from collections.abc import Iterator
from typing import Any

import torch

from ...backends import observing
from ...checks import check_whole
from ...errors import ArgumentError
from ...geometry import backproject, se3
from .gaussian_trace import GaussianSeeded, GaussianTrace, gaussian_moment
from .identity import Identities
from .moments import Moment
from .operations import (
    FusionRecord,
    Record,
    SeedingRecord,
    StepRecord,
    Voxel,
    memory_of,
)
from .recorder import Recorder
from .voxel_trace import VoxelTrace, voxel_moment

MEMORY_BYTES = 256 * 2**20
"""Usual limit of what a trace holds."""

Pick = int | Voxel
"""The number of a Gaussian, or a voxel."""


class Trace:
    """Records what a mapper computes from now on, and answers for one Gaussian or voxel.

    The operations of the mapper are observed while they run: their arguments and results are held,
    and a copy of what they change in place. No number of the map changes. The newest operations are
    held, up to ``memory_bytes``; from the older ones only the part that concerns what was picked
    before stays. What is asked for once is picked from then on, so pick before mapping to follow
    something through a long run. Where a Gaussian comes from and when it left the map is known for
    all of them (about 60 bytes each).

    What was computed for a frame that is undone stays in the trace. A trace is not saved in
    checkpoints; a resumed mapper needs a new one.

    Args:
        mapper: Of other systems than GSFusion, frames that are fused and seeds are recorded, and no
            steps.
        memory_bytes: Limit; the last operation is held even if it alone takes more.

    Raises:
        ValueError: the mapper is already traced.
    """

    def __init__(self, mapper: Any, *, memory_bytes: int = MEMORY_BYTES):
        check_whole("memory_bytes", memory_bytes, 0)
        if any(name.startswith("trace.") for name in mapper.gaussians.columns):
            raise ArgumentError("this mapper is traced already; close the other trace first")
        self.mapper = mapper
        self.identities = Identities(mapper.gaussians)
        self.n_dropped = 0
        """Operations that are no longer held."""
        self._limit_bytes = memory_bytes
        self._held = deque[Record]()
        self._recorder = Recorder(mapper, self.identities, self._hold)
        self._picks: dict[Pick, list[Moment]] = {}
        self._usual = mapper.watch
        mapper.watch = self._watch

    def __repr__(self) -> str:
        return (
            f"Trace({len(self._held)} operations held, {self.memory_bytes / 2**20:.1f} MB, "
            f"{self.identities.count:,} Gaussians so far)"
        )

    @property
    def memory_bytes(self) -> int:
        """Memory of the operations that are held, bytes."""
        return memory_of(self._held)

    def gaussian(self, row: int | None = None, *, id: int | None = None) -> GaussianTrace:
        """The Gaussian in a row of the map as it is now, or the one with a number (also one that
        has left the map).

        Raises:
            IndexError: no such row or number. ValueError: not exactly one of the two is given.
        """
        if (row is None) == (id is None):
            raise ArgumentError("give either the row of a Gaussian in the map or its number, id=")
        if id is None:
            ids = self.identities.now()
            if row is None or not 0 <= row < len(ids):
                raise IndexError(f"row must be between 0 and {len(ids) - 1}, got {row}")
            id = int(ids[row])
        birth = self.identities.birth(id)
        moments: list[Moment] = self._moments(id)
        if birth.cause != "before the trace":
            held_row = (
                r
                for r in self._held
                if isinstance(r, SeedingRecord) and r.frame_index == birth.frame_index
            )
            of = next(held_row, None)
            picture = {} if of is None else {"camera": of.frame.camera, "image": of.frame.colour}
            serial = -1 if of is None else of.serial
            fields = {"serial": serial, "frame_index": birth.frame_index, "birth": birth, **picture}
            moments.insert(0, GaussianSeeded(**fields))
        return GaussianTrace(
            id=id,
            row=self.identities.row_of(id),
            birth=birth,
            moments=tuple(moments),
            events=tuple(self.identities.of(id)),
            n_dropped=self.n_dropped,
        )

    def voxel(self, x: int, y: int, z: int) -> VoxelTrace:
        """The voxel with these integer coordinates (``volume.voxel_index(xyz_W)``)."""
        ijk: Voxel = (x, y, z)
        moments = []
        D = 1.0
        W = 0.0
        for moment in self._moments(ijk):
            if not moment.allocated:  # not in view: it keeps its values
                moment = dataclasses.replace(moment, D=(D, D), W=(W, W))
            D = moment.D[1]
            W = moment.W[1]
            moments.append(moment)
        return VoxelTrace(ijk=ijk, moments=tuple(moments), n_dropped=self.n_dropped)

    def gaussian_at(self, u: int, v: int, serial: int | None = None) -> int:
        """Number of the Gaussian with the largest weight at pixel (u, v): in the held step nearest
        to operation ``serial`` that has one there, by default in the newest.

        Raises:
            ValueError: there is none.
        """
        for record in self._nearest(StepRecord, serial):
            s = record.screen
            if u < record.camera.width and v < record.camera.height:
                blend = s.blend(
                    s.tile_of(u, v),
                    *torch.tensor([[u], [v]], device=s.uv.device),
                )
                if bool((blend.weight > 0).any()):
                    return int(record.ids[int(blend.gaussian[blend.weight[:, 0].argmax()])])
        raise ArgumentError(f"no Gaussian is known at pixel ({u}, {v})")

    def voxel_at(self, u: int, v: int, serial: int | None = None) -> Voxel:
        """The voxel of the surface measured at the centre of pixel (u, v): in the held frame
        nearest to operation ``serial`` that has depth there, by default in the newest.

        Raises:
            ValueError: there is none.
        """
        for record in self._nearest(FusionRecord, serial):
            frame = record.frame
            if u < frame.camera.width and v < frame.camera.height and frame.depth_m[v, u] > 0:
                uv = torch.tensor([u + 0.5, v + 0.5], dtype=torch.float64)
                xyz_C = backproject(
                    frame.camera,
                    uv,
                    frame.depth_m[v, u].cpu().double(),
                )
                xyz_W = se3.apply(frame.T_WC.cpu().double(), xyz_C[None])[0]
                x, y, z = (xyz_W / record.config.voxel_size_m).floor().long().tolist()
                return x, y, z
        raise ArgumentError(f"no voxel is known at pixel ({u}, {v})")

    def close(self) -> None:
        """Stop recording. What was recorded can still be asked for."""
        if self.mapper.watch == self._watch:
            self.mapper.watch = self._usual
            self.identities.close()

    def _nearest(self, kind: type, serial: int | None) -> list[Any]:
        """The held records of a kind, the one nearest to an operation first; by default the newest
        first."""
        at = self._recorder.serial if serial is None else serial
        return sorted(
            (r for r in self._held if isinstance(r, kind)), key=lambda r: abs(r.serial - at)
        )

    def _moments(self, pick: Pick) -> list[Any]:
        moments = self._picks.setdefault(pick, [])
        return [
            *moments,
            *(moment for record in self._held if (moment := _moment(record, pick)) is not None),
        ]

    def _hold(self, record: Record) -> None:
        """Hold a record; of the oldest ones, if they are too large, only what concerns what was
        picked."""
        self._held.append(record)
        while len(self._held) > 1 and self.memory_bytes > self._limit_bytes:
            oldest = self._held.popleft()
            self.n_dropped += 1
            for pick, moments in self._picks.items():
                if (moment := _moment(oldest, pick)) is not None:
                    # it takes most of the memory
                    moments.append(dataclasses.replace(moment, image=None))

    @contextlib.contextmanager
    def _watch(self, frame_index: int | None) -> Iterator[None]:
        self._recorder.begin(frame_index)
        with self._usual(frame_index), observing(self._recorder):
            yield


@contextlib.contextmanager
def tracing(mapper: Any, **options: Any) -> Iterator[Trace]:
    """``with tracing(mapper) as trace:`` records in the block; afterwards the trace can still be
    asked."""
    trace = Trace(mapper, **options)
    try:
        yield trace
    finally:
        trace.close()


def _moment(record: Record, pick: Pick) -> Moment | None:
    return gaussian_moment(record, pick) if isinstance(pick, int) else voxel_moment(record, pick)
