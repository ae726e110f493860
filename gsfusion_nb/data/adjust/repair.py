"""The corrections of ``RepairConfig``, applied to the frames of any sequence."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ...config import RepairConfig
from ...errors import BadFrameError, SequenceError
from ...geometry import pixel_grid, rays, se3
from ...geometry.pose_path import PosePath, pose_between
from ...types import Camera, Frame
from ..depth_registration import warp_depth
from ..lens import same_proportions
from ..recorded.images import read_depth
from ..recorded.recorded_sequence import RecordedSequence
from ..recorded.times import associate
from ..sequence import Sequence, position
from .poses import raw_matrices, reread_poses, stored_poses, times_of

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
        T_WC = self.pose(i)
        depth_of, lag_s = self._depth_images[i]
        frame = self._as_stored(i, colour_of=self._colour_frame(i), depth_of=depth_of)
        return dataclasses.replace(
            frame,
            rgb=self._colour(frame.colour),
            depth_m=self._depth(frame.depth_m, i, lag_s, T_WC),
            camera=self.camera,
            T_WC=T_WC,
        )

    def _as_stored(self, i: int, *, colour_of: int, depth_of: int) -> Frame:
        """Frame ``i`` of the source with the colour and the depth of other frames; of a recording
        no other image is decoded."""
        source = self.source
        if isinstance(source, RecordedSequence):
            return source.frame(i, colour_of=colour_of, depth_of=depth_of)
        frame = source[i]
        if colour_of == depth_of == i:
            return frame
        colour = frame if colour_of == i else source[colour_of]
        depth = frame if depth_of == i else source[depth_of]
        return dataclasses.replace(frame, rgb=colour.colour, depth_m=depth.depth_m)

    def _depth(
        self,
        depth_m: Float[Tensor, "H W"],
        i: int,
        lag_s: float,
        T_WC: Float[Tensor, "4 4"],
    ) -> Float[Tensor, "H W"]:
        """Depth at the pose ``T_WC`` of picture ``i``, of an image that was taken ``lag_s`` later
        from its own pose."""
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
        T_stored = self.source.pose(i).double()
        return reread_poses(T_stored[None], self.repair)[0].float()

    def _colour_frame(self, i: int) -> int:
        """The frame whose colour frame ``i`` gets."""
        other = i + self.repair.rgb_shift_frames
        if not 0 <= other < len(self):
            raise BadFrameError(
                f"{self.name} frame {i} has no colour: repair.rgb_shift_frames needs that of frame "
                f"{other}"
            )
        return other

    def _colour(self, rgb: Shaped[Tensor, "H W 3"]) -> Shaped[Tensor, "H W 3"]:
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
    pixels = cv2.warpAffine(
        rgb.cpu().numpy(),
        to_stored,
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return torch.from_numpy(pixels).to(rgb.device)


def _fitted(source: RecordedSequence) -> RecordedSequence:
    """The recording at the size of its depth images, intrinsics scaled to it."""
    if source.rectification is not None:
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


def as_read(source: Sequence) -> Sequence:
    """The sequence as its reader returned it, without corrections."""
    return source.source if isinstance(source, RepairedSequence) else source
