"""A recording on disk as a sequence, which is what every reader returns, and what a reader says
about its layout."""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...errors import BadFrameError, refusing
from ...geometry.operands import check_depth_scale, check_plausible_camera
from ...types import Camera, Frame
from ..adjust.resize import resize_colour
from ..sequence import Sequence, position
from .decoded_images import DecodedImages
from .images import read_depth, read_rgb
from .poses import checked_pose
from .time_doubts import DoubtfulTimes


@runtime_checkable
class Rectification(Protocol):
    """Images as stored -> the same images as ``RecordedSequence.camera`` sees them (undistortion,
    registration)."""

    def colour(self, rgb: np.ndarray) -> np.ndarray:
        """An image of colours, uint8. [H, W, 3]"""
        ...

    def depth(self, depth_m: np.ndarray) -> np.ndarray:
        """A depth image, metres. [H, W]"""
        ...


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
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
    colour_bits: int = 16
    """How many of their lowest bits colour images of 16 bits use (``read_rgb``)."""
    depth_times_s: list[float] | None = None
    """When the depth images were taken, seconds; None: at the times of the colour images."""
    depth_invalid: tuple[int, ...] = ()
    """Stored depth values that mean "missing", besides 0."""
    rectification: Rectification | None = None
    """Applied to every image (undistortion, registration)."""
    fit_sizes: bool = False
    """Resize colour images of another size than the camera's instead of refusing them."""
    no_times: str = ""
    """Why the recording has no times; ``timestamps_s`` then only count the frames."""
    doubtful_times: DoubtfulTimes | None = None
    """Why ``timestamps_s`` may not be seconds; None: nothing speaks against it."""
    has_poses: bool = True
    """False: the recording has no poses; every pose is the identity, and the mapper must track."""
    novel: frozenset[int] = field(default_factory=frozenset)
    """Frames that the data set publishes as test views: never mapped."""
    read_from: tuple[Path, ...] = ()
    """Every file that was read to open the recording: poses, intrinsics, lists. ``open_sequence``
    notes them."""
    decoded: DecodedImages | None = None
    """Holds images that were decoded before; without it each is decoded whenever it is asked
    for."""

    def __post_init__(self):
        with refusing():
            check_plausible_camera(f"{self.name}: camera", self.camera)
            check_depth_scale(self.name, self.depth_scale)

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        poses = "" if self.has_poses else ", no poses"
        return f"RecordedSequence({self.name!r}, {len(self)} frames, {size}{poses})"

    def __len__(self) -> int:
        return len(self.rgb_files)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i``. Raises ``BadFrameError`` if it is not rigid."""
        i = position(i, len(self))
        return checked_pose(self.poses[i], self.pose_sources[i])

    def colour_image(self, i: int) -> UInt8[Tensor, "H W 3"]:
        """Colour of frame ``i``, the same as ``sequence[i].colour``. No other file is decoded."""
        i = position(i, len(self))
        file = self.rgb_files[i]
        bits = self.colour_bits
        rgb = self._decoded(("colour", file, bits), lambda: read_rgb(file, bits=bits))
        if self.fit_sizes:
            rgb = resize_colour(rgb, self.camera.width, self.camera.height)
        self._check_size(file, rgb)
        if self.rectification is not None:
            rgb = self.rectification.colour(rgb)
        return torch.from_numpy(rgb)

    def depth_image(self, i: int) -> Float[Tensor, "H W"]:
        """z-depth of frame ``i``, metres, the same as ``sequence[i].depth_m``. No other file is
        decoded."""
        i = position(i, len(self))
        file = self.depth_files[i]
        scale = self.depth_scale
        invalid = self.depth_invalid
        depth_m = self._decoded(
            ("depth", file, scale, invalid),
            lambda: read_depth(file, scale=scale, invalid=invalid),
        )
        self._check_size(file, depth_m, ", and registered to colour")
        if self.rectification is not None:
            depth_m = self.rectification.depth(depth_m)
        return torch.from_numpy(depth_m)

    def __getitem__(self, i: int) -> Frame:
        return self.frame(i)

    def frame(self, i: int, *, colour_of: int | None = None, depth_of: int | None = None) -> Frame:
        """Frame ``i``, or its pose and time with the colour or the depth of another frame: each of
        the two files is decoded once, and no other."""
        i = position(i, len(self))
        return Frame(
            T_WC=self.pose(i),
            rgb=self.colour_image(i if colour_of is None else colour_of),
            depth_m=self.depth_image(i if depth_of is None else depth_of),
            index=i,
            timestamp_s=self.timestamps_s[i],
            camera=self.camera,
        )

    def _decoded(self, key: Hashable, decode: Callable[[], np.ndarray]) -> np.ndarray:
        return decode() if self.decoded is None else self.decoded.get(key, decode)

    def _check_size(self, file: Path, image: np.ndarray, condition: str = "") -> None:
        size = image.shape[1::-1]
        camera_size = (self.camera.width, self.camera.height)
        if size != camera_size:
            raise BadFrameError(
                f"{file} is {_wxh(size)}; expected {_wxh(camera_size)}, as the intrinsics "
                f"say{condition}"
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
