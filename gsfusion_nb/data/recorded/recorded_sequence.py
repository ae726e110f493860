"""A recording on disk as a sequence, which is what every reader returns, and what a reader says
about its layout."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import BadFrameError, refusing
from ...geometry.operands import check_depth_scale, check_plausible_camera
from ...types import Camera, Frame
from ..adjust.resize import resize_colour
from ..sequence import Sequence, position
from .images import read_depth, read_rgb
from .poses import checked_pose

Rectify = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Colour (uint8, RGB) and depth (metres) as stored -> the same pair as ``camera`` sees it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedSequence:
    """Files, poses and times of a recorded sequence (a ``Sequence``).

    Frame ``i`` has index ``i``. A frame whose image is damaged, whose depth is all missing or whose
    pose is not rigid raises ``BadFrameError``; the other frames stay readable.

    Raises:
        SequenceError: an impossible camera or depth scale (``gsfusion_nb.geometry.operands``).
    """

    name: str
    camera: Camera
    """Camera of the frames, pixel centres at (i + 0.5, j + 0.5)."""
    rgb_files: list[Path]
    depth_files: list[Path]
    timestamps_s: list[float]
    """When the colour images were taken, seconds; ``poses`` are those of these times."""
    poses: Float[Tensor, "N 4 4"]
    """Camera-to-world, as read; float64."""
    pose_sources: list[str]
    """Where each pose was written, for messages."""
    depth_scale: float
    """Stored depth value of one metre."""
    depth_times_s: list[float] | None = None
    """When the depth images were taken, seconds; None: at the times of the colour images."""
    depth_invalid: tuple[int, ...] = ()
    """Stored depth values that mean "missing", besides 0."""
    rectify: Rectify | None = None
    """Applied to every pair of images (undistortion, registration)."""
    fit_sizes: bool = False
    """Resize colour images of another size than the camera's instead of refusing them."""
    no_times: str = ""
    """Why the recording has no times; ``timestamps_s`` then only count the frames."""
    has_poses: bool = True
    """False: the recording has no poses; every pose is the identity, and the mapper must track."""
    novel: frozenset[int] = field(default_factory=frozenset)
    """Frames that the data set publishes as test views: never mapped."""
    read_from: tuple[Path, ...] = ()
    """Every file that was read to open the recording: poses, intrinsics, lists. ``open_sequence``
    notes them."""

    def __post_init__(self):
        with refusing():
            check_plausible_camera(f"{self.name}: camera", self.camera)
            check_depth_scale(self.name, self.depth_scale)

    def __len__(self) -> int:
        return len(self.rgb_files)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i``. Raises ``BadFrameError`` if it is not rigid."""
        i = position(i, len(self))
        return checked_pose(self.poses[i], self.pose_sources[i])

    def depth_image(self, i: int) -> Float[Tensor, "H W"]:
        """z-depth of frame ``i``, metres, the same as ``sequence[i].depth_m``.

        The colour image is decoded only where both are rectified together, or its size is to be
        compared with the camera's; a damaged one therefore does not matter here.
        """
        i = position(i, len(self))
        if self.rectify is not None:
            return self[i].depth_m
        depth_m = read_depth(
            self.depth_files[i], scale=self.depth_scale, invalid=self.depth_invalid
        )
        size = depth_m.shape[1::-1]
        if size != (self.camera.width, self.camera.height):
            raise BadFrameError(
                f"{self.depth_files[i]} is {_wxh(size)}; expected "
                f"{_wxh((self.camera.width, self.camera.height))}"
            )
        return torch.from_numpy(depth_m)

    def __getitem__(self, i: int) -> Frame:
        i = position(i, len(self))
        T_WC = self.pose(i)
        rgb = read_rgb(self.rgb_files[i])
        depth_m = read_depth(
            self.depth_files[i], scale=self.depth_scale, invalid=self.depth_invalid
        )
        if self.fit_sizes:
            rgb = resize_colour(rgb, self.camera.width, self.camera.height)
        self._check_sizes(i, rgb, depth_m)
        if self.rectify is not None:
            rgb, depth_m = self.rectify(rgb, depth_m)
        return Frame(
            index=i,
            timestamp_s=self.timestamps_s[i],
            rgb=torch.from_numpy(rgb),
            depth_m=torch.from_numpy(depth_m),
            camera=self.camera,
            T_WC=T_WC,
        )

    def _check_sizes(self, i: int, rgb: np.ndarray, depth_m: np.ndarray) -> None:
        rgb_size = rgb.shape[1::-1]
        depth_size = depth_m.shape[1::-1]
        if rgb_size != depth_size:
            raise BadFrameError(
                f"{self.depth_files[i]} is {_wxh(depth_size)} but {self.rgb_files[i]} is "
                f"{_wxh(rgb_size)}; "
                "expected colour and depth of the same size, registered to each other"
            )
        expected = (self.camera.width, self.camera.height)
        if rgb_size != expected:
            raise BadFrameError(
                f"{self.rgb_files[i]} is {_wxh(rgb_size)}; expected {_wxh(expected)}, as the "
                "intrinsics say"
            )


def _wxh(size: tuple[int, ...]) -> str:
    return f"{size[0]}x{size[1]}"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """One way to lay out a sequence on disk."""

    read: Callable[..., Sequence]
    """Reads the folder; its keyword arguments are the options of ``open_sequence`` and of
    ``--reader``."""
    looks_for: tuple[str, ...]
    """Files and folders by which the layout is recognised, patterns allowed; a folder ends in
    "/"."""
    locate: Callable[[Path], Path] = lambda path: path
    """The given folder, or the one inside it that holds these files."""
    registration: Mapping[str, Any] = field(default_factory=dict)
    """Options that register colour to depth, where the layout's files are not registered."""
