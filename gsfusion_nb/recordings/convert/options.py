"""The options of a conversion. Every field is an option of ``gsfusion-nb convert``."""

from dataclasses import dataclass
from typing import Literal

from ...checks import check_number
from ...data.sequence import SequenceError


@dataclass(frozen=True, kw_only=True)
class RosOptions:
    """Topics and frames of a ROS bag; each is found automatically where there is only one candidate."""

    colour_topic: str = ""
    """Colour images (sensor_msgs/Image or CompressedImage)."""
    depth_topic: str = ""
    """Depth images (16UC1 in millimetres, 32FC1 in metres, or compressedDepth)."""
    pose_topic: str = ""
    """PoseStamped, PoseWithCovarianceStamped, TransformStamped or Odometry; "tf" takes the transform tree."""
    camera_info_topic: str = ""
    """Calibration of the colour camera; found beside the colour topic by default."""
    world_frame: str = ""
    """World frame in the transform tree; its root by default."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions:
    """How a recording is read and written."""

    poses: str = ""
    """File with the camera's trajectory, if the recording has none; poses are interpolated at the frames' times: TUM
    text, OKVIS2 or EuRoC csv, ORB-SLAM3 in seconds or nanoseconds. "none" writes no poses at all, for a camera that is
    to be tracked."""
    pose_time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the trajectory's times; "auto" takes the one in which the time steps are plausible."""
    max_gap_s: float = 0.2
    """Largest time between the two poses around a frame; a frame in a longer gap is dropped, seconds."""
    time_offset_s: float = 0.0
    """Added to the time of each frame before its pose is interpolated, seconds."""
    T_cam_body: str = ""
    """File of 16 numbers: body to camera (Kalibr's T_cam_imu), if the trajectory is that of a body or IMU."""
    T_body_cam: str = ""
    """The inverse: camera to body (EuRoC's T_BS, OKVIS's T_SC)."""
    scale: float = 0.0
    """Metres per unit of the poses. 0: measured on the depth images for COLMAP, whose poses have no unit; 1 for all
    other formats."""
    depth: str = ""
    """Folder of the depth images if they are not part of the recording; same names as the colour images."""
    depth_scale: float = 0.0
    """Stored depth value of one metre. 0: that of the format, or 1000 (millimetres) if it has none; TUM-style folders:
    inferred from names, depths and poses, or asked for."""
    depth_along: Literal["auto", "z", "ray"] = "auto"
    """Whether depth is measured along the optical axis ("z") or along the ray of each pixel ("ray"); "auto": as usual
    in the format."""
    intrinsics: str = ""
    """Intrinsics to use instead of those of the recording: "fx fy cx cy [k1 k2 p1 p2 k3]", or a file with these
    numbers, a matrix, or JSON."""
    pixel_centre: float = 0.0
    """Coordinate of the first pixel's centre in these intrinsics: 0 as in OpenCV and ROS, 0.5 as in COLMAP."""
    width: int = 0
    """Width of the images to write, pixels. 0: that of the colour images, or in proportion to the height."""
    height: int = 0
    """Height of the images to write, pixels. 0: that of the colour images, or in proportion to the width."""
    every: int = 1
    """Convert every n-th frame."""
    confidence: int = 1
    """Record3D: smallest confidence at which a depth pixel is kept, 0 (all), 1 (medium) or 2 (high)."""
    ros: RosOptions = RosOptions()

    def __post_init__(self):
        for name in ("max_gap_s", "scale", "depth_scale", "width", "height"):
            check_number(name, getattr(self, name), low=0)
        check_number("time_offset_s", self.time_offset_s)
        check_number("every", self.every, low=1)
        check_number("confidence", self.confidence, low=0, high=2)
        if self.pixel_centre not in (0.0, 0.5):
            raise SequenceError(f"pixel_centre must be 0.0 or 0.5, got {self.pixel_centre}")
        if self.T_cam_body and self.T_body_cam:
            raise SequenceError("give T_cam_body or its inverse T_body_cam, not both")
