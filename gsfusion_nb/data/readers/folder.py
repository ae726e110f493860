"""The plain layout for your own data: ``rgb/``, ``depth/``, ``poses.txt``, ``intrinsics.json``.

    my_scan/
      rgb/000000.jpg ...      8-bit colour, JPEG or PNG, used as stored: a turn that EXIF asks for
                              is not made
      depth/000000.png ...    16-bit, one channel, registered to the colour image; 0 = missing;
                              same names as in rgb/
      poses.txt               one line per image in order: 16 row-major numbers of the
                              camera-to-world matrix, or the name of the image and these
      times.txt               optional, lines "name seconds": when each image was taken; or
                              "name seconds seconds", with the time of its depth, which is then
                              moved to where the camera was for the colour
      intrinsics.json         {"width": 640, "height": 480, "fx": 525, "fy": 525,
                               "cx": 319.5, "cy": 239.5, "depth_scale": 1000}

Keys of ``intrinsics.json``: those seven, and optionally

| key | default | meaning |
|---|---|---|
| ``pixel_centre`` | 0.0 | centre of the first pixel: 0.0 (OpenCV, Open3D, ROS) or 0.5 (COLMAP) |
| ``depth_invalid`` | 0 | a stored depth that means "missing", besides 0 |
| ``fps`` | 30 | frames per second, for the time stamps where there is no times.txt |
| ``pose_convention`` | "camera-to-world" | must begin with that; any comment may follow |

Poses: camera-to-world, OpenCV axes (x right, y down, z forward), metres. Images sort naturally (2
before 10). Where lines of poses.txt begin with names, an image may be missing; else there are as
many poses as images.
"""

from pathlib import Path
from typing import Any

from ...checks import shown
from ...errors import SequenceError
from ...files import read_object
from ..recorded.files import camera, given_name, images_in, number, numbers, pair_by_stem, require
from ..recorded.poses import no_poses, poses_of_images
from ..recorded.recorded_sequence import Layout, RecordedSequence
from ..recorded.time_doubts import warn_of_doubt
from ..recorded.times import TIMES, times_of_images

LOOKS_FOR = ("rgb/", "depth/", "intrinsics.json")
_CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_REQUIRED = (*_CAMERA_KEYS, "depth_scale")
_OPTIONAL = ("pixel_centre", "depth_invalid", "fps", "pose_convention")


def folder(
    path: str | Path, *, poses: bool = True, times: bool = True, colour_bits: int = 16
) -> RecordedSequence:
    """Read a sequence in the plain layout (module docstring).

    Depth scale: ``depth_scale`` of the JSON. Poses: camera-to-world, OpenCV axes. Pixel centres:
    ``pixel_centre`` of the JSON, integers by default, so 0.5 is added to ``cx`` and ``cy``.

    Args:
        path: Folder of the sequence.
        poses: False for a recording without ``poses.txt``; the camera must then be tracked.
        times: False: ``times.txt`` is not read, because its numbers are no times. Times that may
            not be seconds are read, and a warning says why they are doubted.
        colour_bits: How many of their lowest bits colour images of 16 bits use, 8 to 16. A warning
            says where images of 16 bits use 12 or fewer.

    Raises:
        SequenceNotFoundError: the folder or one of its parts is missing.
        SequenceError: no images, a colour image without depth, an image whose pose is missing or
            not known by name, number or count, or an unknown, missing or impossible key or option.
    """
    root = Path(path)
    if colour_bits not in range(8, 17):
        raise SequenceError(f"{root}: colour_bits must be 8 to 16, got {shown(colour_bits)}")
    require(
        root, (*LOOKS_FOR, "poses.txt") if poses else LOOKS_FOR, "folder", without_poses="poses.txt"
    )
    values = read_intrinsics(root / "intrinsics.json")
    rgb_files = images_in(root / "rgb")
    depth_files = pair_by_stem(
        rgb_files, images_in(root / "depth", (".png", ".tif", ".tiff", ".pgm"))
    )
    poses_file = root / "poses.txt"
    T_WC = poses_of_images(poses_file, rgb_files) if poses else no_poses(len(rgb_files))
    read_times, no_times = (
        times_of_images(root / TIMES, rgb_files)
        if times
        else (None, f"the user says that {TIMES} holds none")
    )
    doubt = warn_of_doubt(
        root / TIMES,
        [t for t, _ in read_times or []],
        if_counted="--reader times=false",
    )
    return recording_of(
        root,
        values,
        rgb_files=rgb_files,
        depth_files=depth_files,
        timestamps_s=[t for t, _ in read_times or []]
        or [i / values.get("fps", 30.0) for i in range(len(rgb_files))],
        depth_times_s=[t for _, t in read_times]
        if read_times and any(t != t_depth for t, t_depth in read_times)
        else None,
        doubtful_times=doubt,
        colour_bits=colour_bits,
        no_times="" if "fps" in values else no_times,
        poses=T_WC,
        pose_sources=[f"{poses_file} pose {i}" for i in range(len(T_WC))],
        has_poses=poses,
    )


def recording_of(root: Path, values: dict[str, Any], **frames: Any) -> RecordedSequence:
    """A recording with the camera and the depth scale of ``values``, the content of
    ``intrinsics.json``."""
    shift = 0.5 - values.get("pixel_centre", 0.0)
    return RecordedSequence(
        name=given_name(root),
        camera=camera(values, _CAMERA_KEYS, root / "intrinsics.json", shift=shift),
        depth_scale=float(values["depth_scale"]),
        depth_invalid=(int(values.get("depth_invalid", 0)),),
        **frames,
    )


def read_intrinsics(path: Path) -> dict[str, Any]:
    """The checked values of ``intrinsics.json``."""
    values = read_object(path, "the camera's intrinsics")
    unknown = sorted(set(values) - {*_REQUIRED, *_OPTIONAL})
    if unknown:
        raise SequenceError(
            f"{path} has unknown keys {', '.join(unknown)}; known: "
            f"{', '.join((*_REQUIRED, *_OPTIONAL))}"
        )
    numbers(values, _REQUIRED, path)
    numbers(values, tuple(k for k in ("fps",) if k in values), path)
    if values.get("fps", 30.0) < 1e-3:
        raise SequenceError(f"{path}: fps must be at least 0.001, got {shown(values['fps'])}")
    if number(values, "pixel_centre", 0.0, path) not in (0.0, 0.5):
        raise SequenceError(
            f"{path}: pixel_centre must be 0.0 or 0.5, got {shown(values['pixel_centre'])}"
        )
    invalid = values.get("depth_invalid", 0)
    if isinstance(invalid, bool) or not isinstance(invalid, int) or not 0 <= invalid <= 65535:
        raise SequenceError(
            f"{path}: depth_invalid must be an integer between 0 and 65535, got {shown(invalid)}"
        )
    convention = values.get("pose_convention", "camera-to-world")
    if not str(convention).startswith("camera-to-world"):
        raise SequenceError(
            f"{path}: pose_convention must begin with 'camera-to-world', got {shown(convention)}; "
            "invert the poses"
        )
    return values


LAYOUT = Layout(read=folder, looks_for=LOOKS_FOR)
