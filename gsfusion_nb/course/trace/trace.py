"""Follow a pixel, a voxel or a Gaussian through everything that a mapper does to it."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

from ...backends import observing
from ...checks import check_whole
from .held import HeldRecords
from .identity import Identities
from .moment import Moment
from .of_gaussian import GaussianTrace, gaussian_moment, seeded
from .of_pixel import PixelTrace, pixel_moment
from .of_voxel import Voxel, VoxelFused, VoxelTrace, voxel_moment
from .recorder import Recorder
from .records import Record, SeedingRecord

MEMORY_BYTES = 256 * 2**20
"""Usual limit of what a trace holds."""

Pick = tuple[str, tuple[int, ...]]


class Trace:
    """Records what a mapper computes from now on, and answers for one pixel, voxel or Gaussian.

    The operations of the mapper are observed while they run: their arguments and results are held, and a copy of what
    they change in place. No number of the map changes. The newest operations are held, up to ``memory_bytes``; from the
    older ones only the part that concerns what was picked before stays. What is asked for once is picked from then on,
    so pick before mapping to follow something through a long run. Where a Gaussian comes from and when it left the map
    is known for all of them (about 60 bytes each).

    A frame that is undone is undone in the trace, too. A trace is not saved in checkpoints; a resumed mapper needs a
    new one.

    Args:
        mapper: GSFusion, RTG-SLAM, or another mapper. What a trace does not know of it, it does not record.
        memory_bytes: Limit; the last operation is held even if it alone takes more.

    Raises:
        ValueError: the mapper is already traced.
    """

    def __init__(self, mapper: Any, *, memory_bytes: int = MEMORY_BYTES):
        check_whole("memory_bytes", memory_bytes, 0)
        if any(name.startswith("trace.") for name in mapper.gaussians.columns):
            raise ValueError("this mapper is traced already; close the other trace first")
        self.mapper = mapper
        self.identities = Identities(mapper.gaussians)
        self._held = HeldRecords(memory_bytes, self._leaves)
        self._recorder = Recorder(mapper, self.identities, self._held.add)
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
        return self._held.memory_bytes

    @property
    def n_dropped(self) -> int:
        """Operations that are no longer held."""
        return self._held.n_dropped

    def gaussian(self, row: int | None = None, *, id: int | None = None) -> GaussianTrace:
        """The Gaussian in a row of the map as it is now, or the one with a number (also one that has left the map).

        Raises:
            IndexError: no such row or number. ValueError: not exactly one of the two is given.
        """
        if (row is None) == (id is None):
            raise ValueError("give either the row of a Gaussian in the map or its number, id=")
        if id is None:
            ids = self.identities.now()
            if row is None or not 0 <= row < len(ids):
                raise IndexError(f"row must be between 0 and {len(ids) - 1}, got {row}")
            id = int(ids[row])
        birth = self.identities.birth(id)
        moments = self._moments(("gaussian", (id,)))
        if birth.cause != "before the trace":
            moments = [seeded(self._seeding_of(birth.frame_index), birth), *moments]
        return GaussianTrace(
            id=id, row=self.identities.row_of(id), birth=birth, moments=tuple(moments),
            events=tuple(self.identities.of(id)), n_dropped=self.n_dropped,
        )  # fmt: skip

    def pixel(self, u: int, v: int) -> PixelTrace:
        """The pixel in column ``u`` and row ``v`` of every frame and every rendered view."""
        check_whole("u", u, 0)
        check_whole("v", v, 0)
        moments = self._moments(("pixel", (u, v)))
        return PixelTrace(u=u, v=v, moments=tuple(moments), n_dropped=self.n_dropped)

    def voxel(self, x: int, y: int, z: int) -> VoxelTrace:
        """The voxel with these integer coordinates (``volume.voxel_index(xyz_W)``)."""
        ijk: Voxel = (x, y, z)
        fused, D, W = [], 1.0, 0.0
        for moment in self._moments(("voxel", ijk)):
            assert isinstance(moment, VoxelFused)
            if not moment.allocated:  # not in view: it keeps its values
                moment = dataclasses.replace(moment, D=(D, D), W=(W, W))
            D, W = moment.D[1], moment.W[1]
            fused.append(moment)
        return VoxelTrace(ijk=ijk, moments=tuple(fused), n_dropped=self.n_dropped)

    def close(self) -> None:
        """Stop recording. What was recorded can still be asked for."""
        if self.mapper.watch == self._watch:
            self.mapper.watch = self._usual
            self.identities.close()

    def _moments(self, pick: Pick) -> list[Moment]:
        kept = self._picks.setdefault(pick, [])
        found = [moment for record in self._held if (moment := _moment(record, pick)) is not None]
        return [*kept, *found]

    def _leaves(self, record: Record) -> None:
        for pick, kept in self._picks.items():
            if (moment := _moment(record, pick)) is not None:
                kept.append(moment.without_image())

    def _seeding_of(self, frame_index: int | None) -> SeedingRecord | None:
        held = (r for r in self._held if isinstance(r, SeedingRecord) and r.frame_index == frame_index)
        return next(held, None)

    @contextlib.contextmanager
    def _watch(self, frame_index: int | None) -> Iterator[None]:
        serial, mark = self._recorder.serial, self.identities.mark()
        self._recorder.begin(frame_index)
        try:
            with self._usual(frame_index), observing(self._recorder):
                yield
        except BaseException:
            if not self.mapper.guard.half_mapped:
                self._held.cut(serial)
                self._recorder.serial = serial
                self.identities.go_back(mark)
                for kept in self._picks.values():
                    kept[:] = [moment for moment in kept if moment.serial < serial]
            raise


@contextlib.contextmanager
def tracing(mapper: Any, **options: Any) -> Iterator[Trace]:
    """``with tracing(mapper) as trace:`` records in the block; afterwards the trace can still be asked."""
    trace = Trace(mapper, **options)
    try:
        yield trace
    finally:
        trace.close()


_OF: dict[str, Callable[..., Moment | None]] = {
    "gaussian": gaussian_moment,
    "pixel": pixel_moment,
    "voxel": lambda record, *ijk: voxel_moment(record, ijk),
}


def _moment(record: Record, pick: Pick) -> Moment | None:
    kind, numbers = pick
    return _OF[kind](record, *numbers)
