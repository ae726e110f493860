"""The frames of a sequence that are used: range, size, depth limits, and those held out.

The corrections of ``RepairConfig`` come first (``repaired``).
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...config import DataConfig
from ...errors import BadFrameError, SequenceError
from ...types import Camera, Frame
from ..frame_store import FrameStore
from ..sequence import Sequence, position
from .repair import repaired
from .resize import resize_frame, resized_camera

ExtraOf = Callable[[Frame], Mapping[str, Any]]
"""A function from a frame to further images of it by name, tensors or numpy arrays [H, W, ...]
(``Frame.extra``)."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FrameSubset:
    """Some frames of a sequence, resized and with depth limits (a ``Sequence``). Frames keep the
    source's index."""

    source: Sequence
    positions: list[int]
    """Frames of the source, in order."""
    camera: Camera
    """Camera of the source or a resized one."""
    depth_min_m: float = 0.0
    depth_max_m: float = 0.0
    """0 means no limit."""
    extra: ExtraOf | None = None
    """Gives further images of each frame, at the size of the source."""
    kept: FrameStore | None = None
    """Holds frames that were read before; without it each frame is read whenever it is asked
    for."""

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.source.name

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        return f"{type(self).__name__}({self.name!r}, {len(self)} frames, {size})"

    def __len__(self) -> int:
        return len(self.positions)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i``."""
        return self.source.pose(self.positions[position(i, len(self))])

    def __getitem__(self, i: int) -> Frame:
        if self.kept is None:
            return self._read(self.positions[position(i, len(self))])
        return self._kept(self.kept, self.positions[position(i, len(self))])

    def _kept(self, store: FrameStore, place: int) -> Frame:
        with store.timed():
            frame = store.get(place) if self.extra is None else None
            if frame is None:
                frame = self._read(place)
                store.add(place, frame)
            return frame

    def _read(self, place: int) -> Frame:
        frame = self.source[place]
        if self.extra is not None:
            extra = {**frame.extra, **self.extra(frame)}
            frame = dataclasses.replace(frame, extra=extra)
        return within_depth(
            resize_frame(frame, self.camera), self.depth_min_m, self.depth_max_m, name=self.name
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class OpenedSequence(FrameSubset):
    """All selected frames of a sequence (itself a ``Sequence``), split into those to map and those
    held out."""

    mapping: FrameSubset
    """Frames to map."""
    held_out: FrameSubset
    """Frames never mapped, for novel-view evaluation; may be empty."""

    def keeping(self, store: FrameStore) -> "OpenedSequence":
        """The same frames, of which each that was read is kept in ``store`` for those who read it
        again."""
        parts = {
            name: dataclasses.replace(getattr(self, name), kept=store)
            for name in ("mapping", "held_out")
        }
        return dataclasses.replace(self, **parts, kept=store)

    def __repr__(self) -> str:
        return (
            f"{super().__repr__()[:-1]}: {len(self.mapping)} to map, {len(self.held_out)} held out)"
        )


def apply_options(
    source: Sequence, data: DataConfig | None = None, extra: ExtraOf | None = None
) -> OpenedSequence:
    """Select, resize and split the frames of any sequence.

    Of the frames ``start, start + stride, ...`` below ``stop``, the one at position i is held out
    when ``i % hold_out_every == hold_out_offset``: positions count within the selection, so the
    held-out share does not depend on the stride. Frames that the data set publishes as test views
    (``source.novel``, ScanNet++) are always held out; they are neither counted nor subsampled.

    The corrections of ``data.repair`` are applied first; the frames that they skip keep their
    numbers and are neither counted nor held out.

    ``extra`` gives further images of each frame: ``open_sequence``.

    Raises:
        SequenceError: no frames, a start beyond the end, or nothing left to map.
    """
    if not isinstance(source, Sequence):
        raise SequenceError(
            "expected a sequence (name, camera, len(), [i], pose(i)) or the path of one, got "
            f"{type(source).__name__}"
        )
    data = data or DataConfig()
    source = repaired(source, data.repair)
    test_views = set(getattr(source, "novel", ()))
    skip = set(data.repair.skip)
    novel = sorted(test_views - skip)
    selection = _selection(source, test_views | skip, data)
    every = data.hold_out_every
    offset = data.hold_out_offset
    if every and not 0 <= offset < every:
        raise SequenceError(
            f"data.hold_out_offset must be between 0 and {every - 1} (hold_out_every - 1), got "
            f"{offset}"
        )
    held_positions = [p for i, p in enumerate(selection) if every and i % every == offset]
    map_positions = sorted(set(selection) - set(held_positions))
    if not map_positions:
        raise SequenceError(
            f"{source.name}: holding out every {every}th of {len(selection)} frames leaves none "
            "to map"
        )
    camera = resized_camera(source.camera, data.width, data.height)

    def view(positions: list[int]) -> FrameSubset:
        return FrameSubset(
            source=source,
            positions=positions,
            camera=camera,
            depth_min_m=data.depth_min_m,
            depth_max_m=data.depth_max_m,
            extra=extra,
        )

    everything = view(selection + novel)
    return OpenedSequence(
        **{f.name: getattr(everything, f.name) for f in dataclasses.fields(FrameSubset)},
        mapping=view(map_positions),
        held_out=view(held_positions + novel),
    )


def _selection(source: Sequence, excluded_frames: set[int], data: DataConfig) -> list[int]:
    frames = [i for i in range(len(source)) if i not in excluded_frames]
    if not frames:
        raise SequenceError(f"{source.name} has no frames; expected at least one")
    if data.start >= len(frames):
        raise SequenceError(
            f"{source.name} has {len(frames)} frames; data.start must be below that, got "
            f"{data.start}"
        )
    if 0 < data.stop <= data.start:
        raise SequenceError(
            f"{source.name}: data.stop must be above data.start {data.start}, or 0, got {data.stop}"
        )
    return frames[data.start : data.stop or None : data.stride]


def within_depth(
    frame: Frame,
    near_m: float | int,
    far_m: float | int,
    *,
    name: str,
) -> Frame:
    """The frame without depth nearer than ``near_m`` or farther than ``far_m`` (0: no limit).

    Raises:
        BadFrameError: nothing is left; ``name`` is that of its sequence.
    """
    if near_m == 0 and far_m == 0:
        return frame
    limit_m = far_m or torch.inf
    is_within = (frame.depth_m >= near_m) & (frame.depth_m <= limit_m)
    depth_m = frame.depth_m.where(is_within, 0.0)
    if not bool(depth_m.any()):
        raise BadFrameError(
            f"{name} frame {frame.index} has no depth between {near_m:g} and {limit_m:g} m; "
            "expected some within data.depth_min_m and data.depth_max_m"
        )
    return dataclasses.replace(frame, depth_m=depth_m)
