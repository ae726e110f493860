"""What a reader of a foreign format takes and returns: options, frames, and images that are decoded
on request."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ...config.values import Settings, within
from ...data.lens import CameraModel
from ...data.recorded.images import (
    decode_rgb,
    read_image_bytes,
)
from ...errors import SequenceError, refusing
from ...geometry.operands import check_depth_scale, check_plausible_camera
from .confidence import DepthConfidence
from .depth_files import read_depth_file


@dataclass(frozen=True, kw_only=True)
class RosOptions:
    """Topics and frames of a ROS bag; each is found automatically where there is only one
    candidate."""

    colour_topic: str = ""
    """Colour images (sensor_msgs/Image or CompressedImage)."""
    depth_topic: str = ""
    """Depth images (16UC1 in millimetres, 32FC1 in metres, or compressedDepth)."""
    pose_topic: str = ""
    """PoseStamped, PoseWithCovarianceStamped, TransformStamped or Odometry; "tf" takes the
    transform tree."""
    world_frame: str = ""
    """World frame in the transform tree; its root by default."""


class OptionNeeded(SequenceError):
    """A recording does not say something that an option of the conversion can tell."""

    def __init__(
        self,
        message: str,
        *,
        option: str,
        question: str,
        choices: tuple[str, ...] = (),
    ):
        """
        Args:
            message: Names the option, for those who cannot be asked.
            option: The field of ``ConvertOptions``.
            question: For a person at a terminal.
            choices: The possible answers, if they are few.
        """
        super().__init__(message)
        self.option = option
        self.question = question
        self.choices = choices


@dataclass(frozen=True)
class DepthUnit:
    """The stored depth of one metre, and how it is known."""

    scale: float
    sentence: str
    is_guess: bool = False
    """Nothing in the files tells it, but the camera's motion may."""
    question: OptionNeeded | None = None
    """What is asked where the motion does not tell it, either; None: the guess is good enough to go
    on with."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(Settings):
    """How a recording is read and written."""

    poses: str = ""
    """File with the camera's trajectory, if the recording has none; poses are interpolated at the
    frames' times: TUM text, OKVIS2 or EuRoC csv, ORB-SLAM3 in seconds or nanoseconds. Or one pose
    per frame, as text or NumPy: 16 or 12 numbers of a camera-to-world matrix, or "tx ty tz qx qy qz
    qw". "none" writes no poses at all, for a camera that is to be tracked."""
    pose_time_unit: Literal["auto", "s", "ms", "us", "100ns", "ns"] = "auto"
    """Unit of the trajectory's times; "auto" takes the one in which they are dates of today, or in
    which they span the times of the frames, or in which their steps are those of a camera."""
    pose_quaternions: Literal["auto", "xyzw", "wxyz"] = "auto"
    """Order of the quaternions of poses in a file whose header does not say it; "auto" takes x y z
    w, and the report says so."""
    image_time_unit: Literal["auto", "none", "s", "ms", "us", "100ns", "ns"] = "auto"
    """Unit of the numbers in the names or lists of images. "none": they only number the frames;
    "auto" decides by the numbers and says how."""
    max_gap_s: float = within(0.2, 0)
    """Largest time between the two poses around a frame; a frame in a longer gap is dropped,
    seconds."""
    time_offset_s: float = within(0.0, -math.inf)
    """Added to the time of each frame before its pose is interpolated, seconds."""
    T_cam_body: str = ""
    """File of 16 numbers: body to camera (Kalibr's T_cam_imu), if the trajectory is that of a body
    or IMU."""
    T_body_cam: str = ""
    """The inverse: camera to body (EuRoC's T_BS, OKVIS's T_SC)."""
    scale: float = within(0.0, 0)
    """Metres per unit of the poses. 0: measured on the depth images for COLMAP, whose poses have no
    unit; 1 for all other formats."""
    depth: str = ""
    """Folder of the depth images if they are not part of the recording; same names as the colour
    images."""
    colour: str = ""
    """Folder of the colour images, where a folder of images holds several that may be meant."""
    depth_scale: float = within(0.0, 0)
    """Stored depth value of one metre. 0: that of the format, or 1000 (millimetres) if it has none;
    folders of images: that of their calibration, else measured by the camera's motion, else guessed
    from the depths, or asked for."""
    intrinsics: str = ""
    """Intrinsics to use instead of those of the recording: "fx fy cx cy [k1 k2 p1 p2 k3]", the
    focal length alone, or a file with these numbers, a matrix, or JSON. "estimate" measures the
    focal length of a folder of images."""
    depth_intrinsics: str = ""
    """Intrinsics of the depth images, given as those of colour are, where depth is that of another
    camera and the recording does not say so. "colour": depth is registered to colour, whatever the
    recording says."""
    T_colour_depth: str = ""
    """File of 16 numbers: from the depth camera's frame to the colour camera's. Without it what the
    recording says, or both are at one place."""
    pixel_centre: float = 0.0
    """Coordinate of the first pixel's centre in these intrinsics: 0 as in OpenCV and ROS, 0.5 as in
    COLMAP."""
    colour_bits: int = within(0, 0, 16)
    """How many of their lowest bits colour images of 16 bits use: 12 for a camera of 12 bits whose
    values were stored as they are. 0: all 16, and a line where images use 12 or fewer."""
    width: int = within(0, 0)
    """Width of the images to write, pixels. 0: in proportion to the height, or that of the colour
    images; if these have more than 16 times as many pixels as the depth, 640 for the longer
    side."""
    height: int = within(0, 0)
    """Height of the images to write, pixels. 0: as for the width."""
    start: int = within(0, 0)
    """First frame to convert."""
    stop: int = within(0, 0)
    """Frame before which the conversion ends. 0: after the last one."""
    every: int = within(1, 1)
    """Convert every n-th frame."""
    confidence: int = within(1, 0, 2)
    """Recordings of phones with a confidence of each depth pixel (Record3D, Polycam, StrayScanner,
    ARKitScenes): the smallest at which it is kept, 0 (all), 1 (medium) or 2 (high)."""
    ros: RosOptions = RosOptions()

    def __post_init__(self):
        super().__post_init__()
        if self.pixel_centre not in (0.0, 0.5):
            raise SequenceError(f"pixel_centre must be 0.0 or 0.5, got {self.pixel_centre}")
        if self.colour_bits not in (0, *range(8, 17)):
            raise SequenceError(f"colour_bits must be 0, or 8 to 16, got {self.colour_bits}")
        if self.T_cam_body and self.T_body_cam:
            raise SequenceError("give T_cam_body or its inverse T_body_cam, not both")
        if self.T_colour_depth and self.depth_intrinsics == "colour":
            raise SequenceError(
                "give T_colour_depth, or say that depth is registered to colour, not both"
            )


@dataclass(frozen=True, eq=False)
class RgbdImages:
    """Decoded colour and depth of one frame; they may differ in size."""

    rgb: np.ndarray
    """uint8. [H, W, 3]"""
    depth_m: np.ndarray
    """float32, metres, 0 = missing. [h, w]"""
    encoded: bytes = b""
    """The file that ``rgb`` came from; a JPEG or PNG is written unchanged if no pixel has to
    change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedFrame:
    """One frame of a recording.

    Raises:
        SequenceError: an impossible camera (``gsfusion_nb.geometry.operands``).
    """

    source: str
    """Where it came from, for messages."""
    time_s: float | None
    """When the colour image was taken, seconds; None where the format has no times."""
    model: CameraModel | None
    """Camera of the colour image; None if the format has none; then the user must give it."""
    load: Callable[[], RgbdImages]
    """Decode the images. Raises ``BadFrameError``; valid only until the iterator goes on to the
    next frame."""
    T_WC: Float[Tensor, "4 4"] | None = None
    """Camera-to-world, OpenCV axes, as stored; None where it is unknown."""
    depth_model: CameraModel | None = None
    """Camera of the depth image; None: depth is registered to the colour image, whatever its
    size."""
    T_colour_depth: Float[Tensor, "4 4"] | None = None
    """From the depth camera's frame to the colour camera's; None: they are one camera."""
    depth_time_s: float | None = None
    """When the depth image was taken, seconds; None: with the colour image."""

    def __post_init__(self):
        for kind, model in (("colour", self.model), ("depth", self.depth_model)):
            if model is not None:
                with refusing():
                    check_plausible_camera(f"{self.source}: {kind} camera", model.camera)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A recording in a foreign format.

    Raises:
        SequenceError: an impossible depth scale (``gsfusion_nb.geometry.operands``).
    """

    name: str
    frames: Callable[[], Iterator[RecordedFrame]]
    """In order; a new iterator on each call."""
    n_frames: int
    depth_scale: float = 1000.0
    """Stored depth value of one metre, which the written images keep."""
    unit: DepthUnit | None = None
    """How ``depth_scale`` is known; None: the format or an option says it."""
    depth_along_ray: bool = False
    has_poses: bool = True
    poses_file: str = ""
    """File with the poses, read as ``ConvertOptions.poses`` is."""
    up_to_scale: bool = False
    """Whether the poses have no unit of length."""
    measured_scale: Callable[[], tuple[float, str]] | None = None
    """Metres per unit of the poses, found on the depth images, with a sentence on how certain that
    is."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames that the reader already left out, by reason."""
    notes: tuple[str, ...] = ()
    """Sentences on what was assumed or found."""

    def __post_init__(self):
        with refusing():
            check_depth_scale(self.name, self.depth_scale)


def load_pair(
    colour: Path, depth: Path, scale: float, confidence: DepthConfidence | None = None
) -> RgbdImages:
    """Colour and depth of two files. Raises ``BadFrameError`` naming the one that cannot be
    used."""
    depth_m = read_depth_file(depth, scale)
    if confidence is not None:
        depth_m = confidence.without_doubtful(depth_m)
    return with_colour(read_image_bytes(colour, "colour"), str(colour), depth_m)


def with_colour(data: bytes, source: str, depth_m: np.ndarray) -> RgbdImages:
    """An encoded colour image, decoded, and depth in metres."""
    return RgbdImages(decode_rgb(data, source), depth_m, data)


def with_colour_bits(images: RgbdImages, bits: int, source: str) -> RgbdImages:
    """The images with colour decoded anew from a file of 16 bits of which so many are used; 0: as
    they are. Raises ``BadFrameError`` if a value has more bits."""
    if not bits or not images.encoded:
        return images
    rgb = decode_rgb(images.encoded, source, bits=bits)
    if np.array_equal(rgb, images.rgb):
        return images
    return RgbdImages(rgb, images.depth_m)


def is_picture_file(data: bytes) -> bool:
    """Whether these bytes are a JPEG or PNG file, which can be written unchanged."""
    return data[:2] == b"\xff\xd8" or data[:8] == b"\x89PNG\r\n\x1a\n"
