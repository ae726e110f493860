"""The options of ``DataConfig`` applied to any sequence: the corrections of ``RepairConfig``
(``repaired``), then size, range, depth limits and held-out frames (``apply_options``).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ...config import DataConfig, RepairConfig
from ...errors import BadFrameError, SequenceError
from ...geometry import pixel_grid, rays, se3
from ...types import Camera, Frame
from ..frame_store import FrameStore
from ..lens import same_proportions, warp_depth
from ..recorded.images import read_depth
from ..recorded.recorded_sequence import RecordedSequence
from ..recorded.times import associate
from ..sequence import Sequence, position
from .poses import PosePath, pose_between, raw_matrices, reread_poses, stored_poses, times_of
from .resize import resize_frame

_RAW = ("matrices", "nearest_rotation", "fit_sizes")
"""Corrections without which no frame can be made: they need the numbers of the files."""


def repaired(source: Sequence, repair: RepairConfig) -> Sequence:
    """``source`` with the corrections of ``repair``, or ``source`` itself if there are none.

    ``skip`` is not applied here: frames keep their positions (``apply_options`` selects).

    Raises:
        SequenceError: a correction that needs the files of a recording, for a sequence that has
            none.
    """
    changes = set(repair.changes) - {"skip"}
    if not changes and getattr(source, "depth_times_s", None) is None:
        return source
    raw = [name for name in _RAW if name in changes]
    if raw:
        if not isinstance(source, RecordedSequence):
            raise SequenceError(
                f"{source.name}: repair.{raw[0]} needs a recording on disk; this sequence is in "
                "memory"
            )
        source = dataclasses.replace(source, poses=raw_matrices(source.poses, repair))
        if repair.fit_sizes:
            source = _fitted(source)
        repair = dataclasses.replace(
            repair, matrices="row_major", nearest_rotation=False, fit_sizes=False
        )
    return RepairedSequence(
        source=source, repair=repair, camera=repaired_camera(source.camera, repair)
    )


def repaired_camera(camera: Camera, repair: RepairConfig) -> Camera:
    """The camera, with intrinsics replaced by those that ``repair`` sets."""
    changes = {
        name: getattr(repair, name) for name in ("fx", "fy", "cx", "cy") if getattr(repair, name)
    }
    camera = dataclasses.replace(camera, **changes)
    return dataclasses.replace(
        camera, cx=camera.cx + repair.pixel_shift, cy=camera.cy + repair.pixel_shift
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RepairedSequence:
    """Frames of a source with corrected depth, poses, intrinsics and colour (a ``Sequence``)."""

    source: Sequence
    repair: RepairConfig
    camera: Camera

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.source.name

    @property
    def has_poses(self) -> bool:
        """Whether the source came with poses."""
        return getattr(self.source, "has_poses", True)

    @property
    def novel(self) -> frozenset[int]:
        """Frames that the data set publishes as test views."""
        return getattr(self.source, "novel", frozenset())

    def __len__(self) -> int:
        return len(self.source)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i``. Raises ``BadFrameError`` if a shift in time leaves
        the frame without a pose."""
        if self.repair.pose_offset_s:
            self._reread(i)  # a frame without a pose gets none
            return self._pose_after(position(i, len(self)), 0.0).float()
        at = position(i, len(self)) + self.repair.pose_shift_frames
        first = math.floor(at)
        if not 0 <= at <= len(self) - 1:
            raise BadFrameError(
                f"{self.name} frame {i} has no pose: repair.pose_shift_frames needs that of frame "
                f"{at:g}, expected one of 0 to {len(self) - 1}"
            )
        T = self._reread(first)
        return T if at == first else pose_between(T, self._reread(first + 1), at - first)

    def __getitem__(self, i: int) -> Frame:
        i = position(i, len(self))
        frame = self.source[i]
        T_WC = self.pose(i)
        return dataclasses.replace(
            frame,
            rgb=self._colour(frame, i),
            depth_m=self._depth(frame, i, T_WC),
            camera=self.camera,
            T_WC=T_WC,
        )

    def _depth(
        self,
        frame: Frame,
        i: int,
        T_WC: Float[Tensor, "4 4"],
    ) -> Float[Tensor, "H W"]:
        """Depth at the picture's pose ``T_WC``: the image that was taken nearest to the picture,
        from its own pose."""
        j, lag_s = self._depth_images[i]
        depth_m = frame.depth_m if j == i else self._depth_image(j)
        if self.repair.depth_factor != 1:
            depth_m = depth_m * self.repair.depth_factor
        if self.repair.depth_kind == "ray":
            ray_length = rays(self.camera, pixel_grid(self.camera)).norm(dim=-1)
            depth_m = depth_m / ray_length
        if not lag_s:
            return depth_m
        T_CW = se3.inverse(T_WC.double())
        T_from_depth = T_CW @ self._pose_after(i, lag_s)
        return warp_depth(depth_m, self.camera, self.camera, T_from_depth)

    def _depth_image(self, j: int) -> Float[Tensor, "H W"]:
        """Depth of the source's frame ``j``; of a recording only that image is decoded."""
        source = self.source
        return source.depth_image(j) if isinstance(source, RecordedSequence) else source[j].depth_m

    @functools.cached_property
    def _depth_images(self) -> list[tuple[int, float]]:
        """For each frame the one whose depth image was taken nearest to its picture, and how much
        later, seconds."""
        stamps = getattr(self.source, "depth_times_s", None)
        offset_s = self.repair.depth_offset_s
        if self.repair.depth_pose == "colour" or not self.has_poses or not (stamps or offset_s):
            return [(i, 0.0) for i in range(len(self))]
        rgb_s = self.times_s.tolist()
        depth_s = [t + offset_s for t in stamps or rgb_s]
        nearest = dict(associate(rgb_s, depth_s, max_difference_s=self._path.step_s))
        images = []
        for i in range(len(self)):
            j = nearest.get(i, i)
            images.append((j, depth_s[j] - rgb_s[i]))
        return images

    def _pose_after(self, i: int, seconds: float) -> Float[Tensor, "4 4"]:
        """The pose that the camera had so long after picture ``i`` was taken, float64."""
        seconds += self.repair.pose_offset_s
        taken_s = np.interp(
            i + self.repair.pose_shift_frames,
            np.arange(len(self)),
            self.times_s,
        )
        T = self._path.at(torch.tensor([taken_s + seconds]))[0]
        if not bool(torch.isfinite(T).all()):
            raise BadFrameError(
                f"{self.name} frame {i} has no pose: {seconds:+g} s lead farther than one frame "
                "from every other pose; expected a smaller repair.pose_offset_s or depth_offset_s"
            )
        return T

    @property
    def times_s(self) -> Float[Tensor, " L"]:
        """Times of the frames, seconds. Raises ``SequenceError`` where the recording has none."""
        times_s = times_of(self.source)
        if times_s is None:
            raise SequenceError(
                f"{self.name} has no times, so repair.pose_offset_s and depth_offset_s must be 0"
            )
        return times_s

    @functools.cached_property
    def _path(self) -> PosePath:
        return PosePath(self.times_s, reread_poses(stored_poses(self.source), self.repair))

    def _reread(self, i: int) -> Float[Tensor, "4 4"]:
        stored = self.source.pose(i).double()
        return reread_poses(stored[None], self.repair)[0].float()

    def _colour(self, frame: Frame, i: int) -> Shaped[Tensor, "H W 3"]:
        other = i + self.repair.rgb_shift_frames
        if not 0 <= other < len(self):
            raise BadFrameError(
                f"{self.name} frame {i} has no colour: repair.rgb_shift_frames needs that of frame "
                f"{other}"
            )
        rgb = frame.colour if other == i else self.source[other].colour
        axes = _MIRRORED_AXES[self.repair.rgb_mirror]
        return shifted_colour(rgb.flip(axes) if axes else rgb, self.repair)


_MIRRORED_AXES = {"none": (), "x": (1,), "y": (0,), "xy": (0, 1)}
"""By the name of the axes along which a picture is mirrored: the axes of its array."""


def shifted_colour(rgb: Shaped[Tensor, "H W 3"], repair: RepairConfig) -> Shaped[Tensor, "H W 3"]:
    """Colour moved back by the shift and scale of ``repair``: pixel u takes the colour at
    m + s (u - m) + shift, with m the image centre.

    The shift is the same for all depths: exact for a rotated or wrongly cropped colour image,
    approximate for a second
        camera.
    """
    shift = (repair.rgb_shift_x_px, repair.rgb_shift_y_px)
    s = repair.rgb_scale
    if shift == (0.0, 0.0) and s == 1.0:
        return rgb
    size = (rgb.shape[1], rgb.shape[0])
    offset = [(1 - s) * (n - 1) / 2 + d for n, d in zip(size, shift, strict=True)]
    to_stored = np.array([[s, 0, offset[0]], [0, s, offset[1]]])
    moved = cv2.warpAffine(
        rgb.cpu().numpy(),
        to_stored,
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return torch.from_numpy(moved).to(rgb.device)


def _fitted(source: RecordedSequence) -> RecordedSequence:
    """The recording at the size of its depth images, intrinsics scaled to it."""
    if source.rectify is not None:
        raise SequenceError(
            f"{source.name}: repair.fit_sizes cannot be combined with undistortion or registration"
        )
    for file in source.depth_files:
        try:
            height, width = read_depth(file, scale=source.depth_scale).shape
        except BadFrameError:
            continue
        size = (source.camera.width, source.camera.height)
        if not same_proportions((width, height), size):
            raise SequenceError(
                f"{file} is {width}x{height}, but the intrinsics are for {size[0]}x{size[1]}, of "
                "other proportions; repair.fit_sizes is for images of one view"
            )
        return dataclasses.replace(
            source, camera=source.camera.resized(width, height), fit_sizes=True
        )
    raise SequenceError(
        f"{source.name}: none of its depth images can be read; expected one, whose size is used"
    )


ExtraOf = Callable[[Frame], Mapping[str, Any]]
"""A function from a frame to further images of it by name, tensors or numpy arrays [H, W, ...]
(``Frame.extra``)."""


def as_read(source: Sequence) -> Sequence:
    """The sequence as its reader returned it, without corrections."""
    return source.source if isinstance(source, RepairedSequence) else source


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class SequenceView:
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

    def _kept(self, kept: FrameStore, place: int) -> Frame:
        with kept.timed():
            frame = kept.get(place) if self.extra is None else None
            if frame is None:
                frame = self._read(place)
                kept.add(place, frame)
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
class OpenedSequence(SequenceView):
    """All selected frames of a sequence (itself a ``Sequence``), split into those to map and those
    held out."""

    mapping: SequenceView
    """Frames to map."""
    held_out: SequenceView
    """Frames never mapped, for novel-view evaluation; may be empty."""

    def keeping(self, kept: FrameStore) -> "OpenedSequence":
        """The same frames, of which each that was read is kept in ``kept`` for those who read it
        again."""
        parts = {
            name: dataclasses.replace(getattr(self, name), kept=kept)
            for name in ("mapping", "held_out")
        }
        return dataclasses.replace(self, **parts, kept=kept)

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
    published = set(getattr(source, "novel", ()))
    skipped = set(data.repair.skip)
    novel = sorted(published - skipped)
    chosen = _selection(source, published | skipped, data)
    every = data.hold_out_every
    offset = data.hold_out_offset
    if every and not 0 <= offset < every:
        raise SequenceError(
            f"data.hold_out_offset must be between 0 and {every - 1} (hold_out_every - 1), got "
            f"{offset}"
        )
    held = [p for i, p in enumerate(chosen) if every and i % every == offset]
    mapped = sorted(set(chosen) - set(held))
    if not mapped:
        raise SequenceError(
            f"{source.name}: holding out every {every}th of {len(chosen)} frames leaves none to map"
        )
    camera = resized_camera(source.camera, data.width, data.height)

    def view(positions: list[int]) -> SequenceView:
        return SequenceView(
            source=source,
            positions=positions,
            camera=camera,
            depth_min_m=data.depth_min_m,
            depth_max_m=data.depth_max_m,
            extra=extra,
        )

    everything = view(chosen + novel)
    return OpenedSequence(
        **{f.name: getattr(everything, f.name) for f in dataclasses.fields(SequenceView)},
        mapping=view(mapped),
        held_out=view(held + novel),
    )


def _selection(source: Sequence, apart: set[int], data: DataConfig) -> list[int]:
    frames = [i for i in range(len(source)) if i not in apart]
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


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """Camera at the requested size, pixels; 0 keeps the proportions, and two zeros keep the
    size."""
    if not width and not height:
        return camera
    width = width or max(1, round(camera.width * height / camera.height))
    height = height or max(1, round(camera.height * width / camera.width))
    return camera.resized(width, height)


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
    far = far_m or torch.inf
    kept = (frame.depth_m >= near_m) & (frame.depth_m <= far)
    depth_m = frame.depth_m.where(kept, 0.0)
    if not bool(depth_m.any()):
        raise BadFrameError(
            f"{name} frame {frame.index} has no depth between {near_m:g} and {far:g} m; expected "
            "some within data.depth_min_m and data.depth_max_m"
        )
    return dataclasses.replace(frame, depth_m=depth_m)
