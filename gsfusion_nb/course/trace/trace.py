"""Follow a pixel, a voxel or a Gaussian through everything that a mapper does to it.

The operations that the mapper runs are turned into records, without changing them."""

import contextlib
import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from ...backends import observing
from ...checks import check_whole
from ...geometry import se3
from ...optim import PartOfMap
from ...optim.adam import ColumnRates
from ...seeding import rule_name
from ...tsdf.integrate import blocks_in_view
from ...types import GaussianParams
from .gaussian import GaussianTrace, Moment, gaussian_moment, seeded
from .identity import Identities, origin_of
from .pixel_and_voxel import PixelTrace, Voxel, VoxelFused, VoxelTrace, pixel_moment, voxel_moment
from .records import AdamColumn, FusionRecord, Record, SeedingRecord, StepRecord, memory_of

Call = Callable[..., Any]


class Recorder:
    """The observer of one mapper (``gsfusion_nb.backends``).

    Args:
        mapper: What is observed.
        identities: Of the rows of its map.
        add: Takes each record.
    """

    def __init__(self, mapper: Any, identities: Identities, add: Callable[[Record], None]):
        self.mapper, self.identities, self._add = mapper, identities, add
        self.serial = 0
        self.frame_index: int | None = None
        self._asking: dict[str, Any] | None = None
        self._step: dict[str, Any] | None = None
        self._seeding: SeedingRecord | None = None
        self._editing = False
        self._last: dict[str, AdamColumn] = {}
        self._handlers = {
            "quadtree": self._quadtree,
            "apply_rule": self._apply_rule,
            "GaussianModel.append": self._append,
            "apply_edit": self._apply_edit,
            "GSFusion._optimise_view": self._optimise_view,
            "render_forward": self._render_forward,
            "render_vjp": self._render_vjp,
            "adam_step": self._adam_step,
            "adam_update_map": self._adam_update_map,
            "fuse_frame_": self._fuse_frame,
        }

    def __call__(self, name: str, f: Call, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run ``f`` and record what it did."""
        handler = self._handlers.get(name)
        return f(*args, **kwargs) if handler is None else handler(f, args, kwargs)

    def begin(self, frame_index: int | None) -> None:
        """A frame begins, or a step after the scan."""
        self.frame_index = frame_index
        self._asking = self._step = self._seeding = None
        self._editing = False

    def _next(self) -> dict[str, Any]:
        self.serial += 1
        return {"serial": self.serial - 1, "frame_index": self.frame_index}

    def _quadtree(self, f: Call, args: tuple, kwargs: dict) -> Any:
        cells = f(*args, **kwargs)
        if self._asking is not None:
            self._asking["cells"] = cells
        return cells

    def _apply_rule(self, f: Call, args: tuple, kwargs: dict) -> Any:
        rule, ctx = args[:2]
        self._asking = {"cells": None}
        try:
            seeds = f(*args, **kwargs)
        finally:
            asked, self._asking = self._asking, None
        self._seeding = SeedingRecord(**self._next(), frame=ctx.frame, rule=rule_name(rule), seeds=seeds, **asked)
        self._add(self._seeding)
        return seeds

    def _append(self, f: Call, args: tuple, kwargs: dict) -> Any:
        model, seeds = args[:2]
        if model is not self.identities.model:
            return f(*args, **kwargs)
        before = len(model)
        out = f(*args, **kwargs)
        asked = self._seeding
        mine = asked is not None and asked.seeds is seeds and len(seeds) > 0
        rule = rule_name(self.mapper.rule)
        more = origin_of(asked, seeds) if mine and asked is not None else {}
        cause = "added by the rule" if self._editing else "seed"
        self.identities.number(torch.arange(before, len(model)), cause, self.frame_index, rule, **more)
        return out

    def _apply_edit(self, f: Call, args: tuple, kwargs: dict) -> Any:
        model, edit = args[:2]
        if model is not self.identities.model:
            return f(*args, **kwargs)
        plain = edit.resolved(model.params.sh, "state" in model.columns)
        ids, count = self.identities.now(), self.identities.count
        self._editing = True
        try:
            origin = f(*args, **kwargs)
        finally:
            self._editing = False
        self.identities.edited(plain, ids, count, origin, self._next(), rule_name(self.mapper.rule))
        return origin

    def _optimise_view(self, f: Call, args: tuple, kwargs: dict) -> Any:
        mapper, view = args[:2]
        if mapper is not self.mapper:
            return f(*args, **kwargs)
        target = view.colour if hasattr(view, "colour") else view.rgb_u8
        self._step = {"view_index": view.index, "target": target, "ids": self.identities.now()} | self._next()
        loss, mse = f(*args, **kwargs)
        step, self._step = self._step, None
        if "screen" in step and "adam" in step:
            at = step.pop("view_index")
            stage = "passes" if self.frame_index is None else "frame" if at == self.frame_index else "keyframe"
            self._add(StepRecord(stage=stage, view_index=at, loss=loss, **step))
        return loss, mse

    def _render_forward(self, f: Call, args: tuple, kwargs: dict) -> Any:
        output, saved = f(*args, **kwargs)
        if self._step is not None and "screen" not in self._step:
            self._step |= {"screen": saved.screen, "rgb": output.rgb, "alpha": output.alpha, "camera": args[1]}
        return output, saved

    def _render_vjp(self, f: Call, args: tuple, kwargs: dict) -> Any:
        if self._step is not None and len(args) > 1:
            self._step["v_rgb"] = args[1]
        return f(*args, **kwargs)

    def _adam_step(self, f: Call, args: tuple, kwargs: dict) -> Any:
        model, gradients = args[:2]
        part = model if isinstance(model, PartOfMap) else None
        if self._step is None or (model if part is None else part.model) is not self.mapper.gaussians:
            return f(*args, **kwargs)
        rows = torch.arange(len(self._step["ids"])) if part is None else part.rows.cpu()
        self._step |= {"rows": rows, "ids": self._step["ids"][rows]}
        moments = (model.params, model.exp_avg, model.exp_avg_sq)
        before = [self._shared(_copies(rows), kind) for rows, kind in zip(moments, _KINDS, strict=True)]
        out = f(*args, **kwargs)
        after = [_copies(rows) for rows in moments]
        self._step["adam"] = self._last = {
            name: AdamColumn(
                before=before[0][name], gradient=gradient, m_before=before[1][name], v_before=before[2][name],
                after=after[0][name], m_after=after[1][name], v_after=after[2][name],
            )
            for name, gradient in vars(gradients).items()
        }  # fmt: skip
        return out

    def _adam_update_map(self, f: Call, args: tuple, kwargs: dict) -> Any:
        if self._step is not None:
            rates: ColumnRates = kwargs["rates"]
            t = args[4]
            self._step["rates"] = rates.by_column(args[0].sh)
            self._step["t"] = t.clone() if isinstance(t, Tensor) else t
        return f(*args, **kwargs)

    def _shared(self, values: dict[str, Tensor], kind: str) -> dict[str, Tensor]:
        """The values, as the tensors that the last step ended with where these are equal: they are then held once."""
        out = {}
        for name, value in values.items():
            last = getattr(self._last[name], kind) if name in self._last else None
            out[name] = last if last is not None and torch.equal(last, value) else value
        return out

    def _fuse_frame(self, f: Call, args: tuple, kwargs: dict) -> Any:
        volume, frame = args[:2]
        if volume is not getattr(self.mapper, "volume", None):
            return f(*args, **kwargs)
        rows = blocks_in_view(volume, frame.camera, se3.inverse(frame.T_WC.double()))
        before = volume.D[rows], volume.W[rows]
        out = f(*args, **kwargs)
        self._add(
            FusionRecord(
                **self._next(), frame=frame, config=volume.config, coords=volume.block_coords[rows].clone(),
                D_before=before[0], W_before=before[1], D_after=volume.D[rows], W_after=volume.W[rows],
            )
        )  # fmt: skip
        return out


_KINDS = ("after", "m_after", "v_after")


def _copies(params: GaussianParams) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in vars(params).items()}


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

    What was computed for a frame that is undone stays in the trace. A trace is not saved in checkpoints; a resumed
    mapper needs a new one.

    Args:
        mapper: Of other systems than GSFusion, frames that are fused and seeds are recorded, and no steps.
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
        self.n_dropped = 0
        """Operations that are no longer held."""
        self._limit_bytes, self._held = memory_bytes, deque[Record]()
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

    def _hold(self, record: Record) -> None:
        """Hold a record; of the oldest ones, if they are too large, only what concerns what was picked."""
        self._held.append(record)
        while len(self._held) > 1 and self.memory_bytes > self._limit_bytes:
            oldest = self._held.popleft()
            self.n_dropped += 1
            for pick, kept in self._picks.items():
                if (moment := _moment(oldest, pick)) is not None:
                    kept.append(moment.without_image())

    def _seeding_of(self, frame_index: int | None) -> SeedingRecord | None:
        held = (r for r in self._held if isinstance(r, SeedingRecord) and r.frame_index == frame_index)
        return next(held, None)

    @contextlib.contextmanager
    def _watch(self, frame_index: int | None) -> Iterator[None]:
        self._recorder.begin(frame_index)
        with self._usual(frame_index), observing(self._recorder):
            yield


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
