"""A recording with the corrections of ``RepairConfig``; they can be applied to any sequence."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ...config import RepairConfig
from ...geometry import pixel_grid, rays
from ...types import Camera, Frame
from ..recorded.images import read_depth
from ..recorded.recorded_sequence import RecordedSequence
from ..sequence import BadFrameError, Sequence, SequenceError, position
from .pose_conventions import pose_between, raw_matrices, reread_poses
from .pose_path import PosePath, times_of

_RAW = ("matrices", "nearest_rotation", "fit_sizes")
"""Corrections without which no frame can be made: they need the numbers of the files."""


def repaired(source: Sequence, repair: RepairConfig) -> Sequence:
    """``source`` with the corrections of ``repair``, or ``source`` itself if there are none.

    ``skip`` is not applied here: frames keep their positions (``apply_options`` selects).

    Raises:
        SequenceError: a correction that needs the files of a recording, for a sequence that has none.
    """
    changes = set(repair.changes) - {"skip"}
    if not changes:
        return source
    raw = [name for name in _RAW if name in changes]
    if raw:
        if not isinstance(source, RecordedSequence):
            raise SequenceError(f"{source.name}: repair.{raw[0]} needs a recording on disk; this sequence is in memory")
        source = dataclasses.replace(source, poses=raw_matrices(source.poses, repair))
        if repair.fit_sizes:
            source = _fitted(source)
        repair = dataclasses.replace(repair, matrices="row_major", nearest_rotation=False, fit_sizes=False)
    return RepairedSequence(source=source, repair=repair, camera=repaired_camera(source.camera, repair))


def repaired_camera(camera: Camera, repair: RepairConfig) -> Camera:
    """The camera, with intrinsics replaced by those that ``repair`` sets."""
    changes = {name: getattr(repair, name) for name in ("fx", "fy", "cx", "cy") if getattr(repair, name)}
    camera = dataclasses.replace(camera, **changes)
    return dataclasses.replace(camera, cx=camera.cx + repair.pixel_shift, cy=camera.cy + repair.pixel_shift)


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
        """Camera-to-world pose of frame ``i``. Raises ``BadFrameError`` if a shift in time leaves the frame without a
        pose."""
        if self.repair.pose_offset_s:
            return self._pose_at_its_time(position(i, len(self)))
        at = position(i, len(self)) + self.repair.pose_shift_frames
        first = math.floor(at)
        if not 0 <= at <= len(self) - 1:
            raise BadFrameError(
                f"{self.name} frame {i} has no pose: repair.pose_shift_frames needs that of frame {at:g}, "
                f"expected one of 0 to {len(self) - 1}"
            )
        T = self._reread(first)
        return T if at == first else pose_between(T, self._reread(first + 1), at - first)

    def __getitem__(self, i: int) -> Frame:
        i = position(i, len(self))
        frame = self.source[i]
        depth_m = frame.depth_m * self.repair.depth_factor
        if self.repair.depth_kind == "ray":
            depth_m = depth_m / rays(self.camera, pixel_grid(self.camera)).norm(dim=-1)
        return dataclasses.replace(
            frame, rgb=self._colour(frame, i), depth_m=depth_m, camera=self.camera, T_WC=self.pose(i)
        )

    def _pose_at_its_time(self, i: int) -> Float[Tensor, "4 4"]:
        """The pose that the camera had when picture ``i`` was taken."""
        self._reread(i)  # a frame without a pose gets none
        T = self._path.at(self.times_s[i : i + 1] + self.repair.pose_offset_s)[0]
        if not bool(torch.isfinite(T).all()):
            raise BadFrameError(
                f"{self.name} frame {i} has no pose: repair.pose_offset_s {self.repair.pose_offset_s:g} s leads "
                "farther than one frame from every other pose; expected a smaller offset"
            )
        return T.float()

    @property
    def times_s(self) -> Float[Tensor, " L"]:
        """Times of the frames, seconds. Raises ``SequenceError`` where the recording has none."""
        times_s = times_of(self.source)
        if times_s is None:
            raise SequenceError(f"{self.name} has no times, so repair.pose_offset_s must be 0")
        return times_s

    @functools.cached_property
    def _path(self) -> PosePath:
        poses = torch.full((len(self), 4, 4), torch.nan, dtype=torch.float64)
        for i in range(len(self)):
            with contextlib.suppress(BadFrameError):
                poses[i] = reread_poses(self.source.pose(i).double()[None], self.repair)[0]
        return PosePath(self.times_s, poses)

    def _reread(self, i: int) -> Float[Tensor, "4 4"]:
        return reread_poses(self.source.pose(i).double()[None], self.repair)[0].float()

    def _colour(self, frame: Frame, i: int) -> Shaped[Tensor, "H W 3"]:
        other = i + self.repair.rgb_shift_frames
        if not 0 <= other < len(self):
            raise BadFrameError(
                f"{self.name} frame {i} has no colour: repair.rgb_shift_frames needs that of frame {other}"
            )
        rgb = frame.colour if other == i else self.source[other].colour
        axes = {"none": (), "x": (1,), "y": (0,), "xy": (0, 1)}[self.repair.rgb_mirror]
        return shifted_colour(rgb.flip(axes) if axes else rgb, self.repair)


def shifted_colour(rgb: Shaped[Tensor, "H W 3"], repair: RepairConfig) -> Shaped[Tensor, "H W 3"]:
    """Colour moved back by the shift and scale of ``repair``: pixel u takes the colour at m + s (u - m) + shift, with m
    the image centre.

    The shift is the same for all depths: exact for a rotated or wrongly cropped colour image, approximate for a second
        camera.
    """
    shift = (repair.rgb_shift_x_px, repair.rgb_shift_y_px)
    s = repair.rgb_scale
    if shift == (0.0, 0.0) and s == 1.0:
        return rgb
    import cv2
    import numpy as np

    size = (rgb.shape[1], rgb.shape[0])
    offset = [(1 - s) * (n - 1) / 2 + d for n, d in zip(size, shift, strict=True)]
    moved = cv2.warpAffine(
        rgb.cpu().numpy(), np.array([[s, 0, offset[0]], [0, s, offset[1]]]), size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return torch.from_numpy(moved).to(rgb.device)


def _fitted(source: RecordedSequence) -> RecordedSequence:
    """The recording at the size of its depth images, intrinsics scaled to it."""
    if source.rectify is not None:
        raise SequenceError(f"{source.name}: repair.fit_sizes cannot be combined with undistortion or registration")
    for file in source.depth_files:
        try:
            height, width = read_depth(file, scale=source.depth_scale).shape
        except BadFrameError:
            continue
        return dataclasses.replace(source, camera=source.camera.resized(width, height), fit_sizes=True)
    raise SequenceError(f"{source.name}: none of its depth images can be read; expected one, whose size is used")
