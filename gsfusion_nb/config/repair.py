"""Corrections of a recording: units, poses, axes, times, intrinsics, and colour beside depth."""

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Literal

from ..errors import ArgumentError
from .values import Settings, positive, within

_DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "back"))
NAMED_AXES = {
    "opencv": "right-down-forward",
    "opengl": "right-up-back",
    "ros": "forward-left-up",
    "unity": "right-up-forward",
}
"""Camera axes x-y-z by the name of a program that uses them; "unity" mirrors the world."""
AXES = tuple(
    "-".join(words)
    for kinds in itertools.permutations(_DIRECTIONS)
    for words in itertools.product(*kinds)
)
"""All 48 ways to name the directions of a camera's x, y and z axes; half of them mirror the
world."""


@dataclass(frozen=True, kw_only=True)
class RepairConfig(Settings, group="repair"):
    """Corrections applied while a recording is read; ``gsfusion-nb check DATA`` finds them. The
    defaults change nothing."""

    depth_factor: float = positive(1.0)
    """Depth is multiplied by this: 0.2 if 5000 units are a metre and 1000 were assumed."""
    depth_kind: Literal["z", "ray"] = "z"
    """Direction in which the stored depth is measured: "z", along the optical axis, or "ray", along
    the ray of each pixel (some simulators)."""
    poses: Literal["camera_to_world", "world_to_camera", "rotation_inverted"] = "camera_to_world"
    """What the stored poses are; "rotation_inverted" means the position of the camera with the
    world-to-camera rotation."""
    axes: str = "opencv"
    """Camera axes of the stored poses: opencv, opengl, ros, unity, or three words such as
    right-up-back."""
    quaternions: Literal["as_read", "wxyz", "xyzw"] = "as_read"
    """Order in which the file stores a quaternion, if the reader assumed the other one; "as_read"
    changes nothing."""
    matrices: Literal["row_major", "column_major"] = "row_major"
    """Order in which the file stores the 16 numbers of a matrix."""
    nearest_rotation: bool = False
    """Replace rotations that are scaled or not orthogonal by the nearest rotation."""
    translation_factor: float = positive(1.0)
    """Positions of the poses are multiplied by this: 0.001 if they are in millimetres."""
    pose_shift_frames: float = within(0.0, -1e4, 1e4)
    """Frame i gets the pose recorded for frame i + this, interpolated between frames if it is not a
    whole number."""
    pose_offset_s: float = within(0.0, -10, 10)
    """Every picture was taken this much later than its pose, seconds; it gets the pose of its time,
    interpolated. gsfusion-nb check DATA estimates it. Usual: within 0.03."""
    depth_offset_s: float = within(0.0, -10, 10)
    """Every depth image was taken this much later than it is stamped beside the pictures, seconds.
    A frame gets the depth image nearest to its picture in time, moved to the picture's pose. Usual:
    within 0.03."""
    depth_pose: Literal["own", "colour"] = "own"
    """Pose from which a depth image was taken at another time than its picture: "own", that of its
    time, from which it is moved to the picture's; or "colour", the picture's, as if both were taken
    at once. Tracked poses: "colour"."""
    rgb_shift_frames: int = within(0, -1e4, 1e4)
    """Frame i gets the colour image of frame i + this."""
    fit_sizes: bool = False
    """Resize colour and intrinsics to the size of the depth images where they differ."""
    fx: float = within(0.0, 0, 1e5)
    """Focal length along x that replaces the recorded one, pixels; 0 keeps it."""
    fy: float = within(0.0, 0, 1e5)
    """Focal length along y that replaces the recorded one, pixels; 0 keeps it."""
    cx: float = within(0.0, 0, 1e5)
    """Principal point, x, that replaces the recorded one, from the left edge of the image, pixels;
    0 keeps it."""
    cy: float = within(0.0, 0, 1e5)
    """Principal point, y, that replaces the recorded one, from the upper edge of the image, pixels;
    0 keeps it."""
    pixel_shift: float = within(0.0, -1e4, 1e4)
    """Added to cx and cy, pixels: 0.5 if the recording counts pixel centres as whole numbers and
    edges were assumed, -0.5 for the opposite."""
    rgb_mirror: Literal["none", "x", "y", "xy"] = "none"
    """Mirror the colour images left-right (x), upside down (y) or both."""
    rgb_shift_x_px: float = within(0.0, -1e4, 1e4)
    """Shift of the colour image relative to the depth image, pixels; positive if its content lies
    too far right."""
    rgb_shift_y_px: float = within(0.0, -1e4, 1e4)
    """Shift of the colour image relative to the depth image, pixels; positive if its content lies
    too far down."""
    rgb_scale: float = positive(1.0)
    """Scale of the colour image's content relative to the depth image's, about the image centre:
    1.02 if things are 2 % larger in colour."""
    skip: tuple[int, ...] = within((), 0)
    """Numbers of the frames to leave out, for example frozen or blurred ones."""

    def __post_init__(self):
        super().__post_init__()
        if self.pose_offset_s and self.pose_shift_frames:
            raise ArgumentError(
                "set repair.pose_offset_s or repair.pose_shift_frames, not both: each moves the "
                "poses in time"
            )
        if self.axes not in NAMED_AXES and self.axes not in AXES:
            raise ArgumentError(
                f"repair.axes must be one of {', '.join(NAMED_AXES)} or three words such as "
                f"right-up-back, got {self.axes!r}"
            )

    @property
    def axis_words(self) -> tuple[str, ...]:
        """Directions of the stored camera's x, y and z axes, as words."""
        return tuple(NAMED_AXES.get(self.axes, self.axes).split("-"))

    @property
    def changes(self) -> dict[str, object]:
        """The fields that differ from their defaults."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {
            f.name: values[f.name] for f in dataclasses.fields(self) if values[f.name] != f.default
        }

    @property
    def flags(self) -> str:
        """The options of ``gsfusion-nb map`` that ask for this; empty if it changes nothing."""
        words = []
        for name, value in self.changes.items():
            words.append(f"--data.repair.{name.replace('_', '-')}")
            if not isinstance(value, bool):
                words += [f"{v:.7g}" if isinstance(v, float) else str(v) for v in _values(value)]
        return " ".join(words)


def _values(value: object) -> tuple:
    return value if isinstance(value, tuple) else (value,)
