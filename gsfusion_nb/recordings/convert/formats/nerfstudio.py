"""Nerfstudio's ``transforms.json``, also as written by instant-ngp, NeRFCapture, Polycam and
similar programs, with the depth image of each frame in ``depth_file_path`` or ``depth_path``.

Poses are camera-to-world with OpenGL axes (y up, z backward), converted to OpenCV axes by C2W
diag(1, -1, -1, 1). Pixel centres at 0.5. Intrinsics are global or per frame; k1..k4, p1, p2 are
removed. ``applied_transform`` and ``applied_scale``, which say how the world was moved and scaled,
are undone, so that depth and poses have the same unit. What the file or a frame says of its depth
(``nerfstudio_depth``) is used; what may say that poses are others is refused, and other keys are
named (``nerfstudio_keys``).
"""

import math
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....data.lens import CameraModel
from ....data.recorded.files import natural_order, number, told_outside
from ....data.recorded.images import read_rgb
from ....data.recorded.poses import GL_TO_CV
from ....errors import SequenceError
from ....files import is_file, parsing, read_object
from ....geometry import se3
from ..camera_numbers import model_of
from ..depth_files import find_depth
from ..pose_list import check_last_rows
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair
from .nerfstudio_depth import meaning_of_depth, note_on_depth
from .nerfstudio_keys import check_poses_as_read, notes_on_unused

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE")

_DEPTH_KEYS = ("depth_file_path", "depth_path")
"""Of nerfstudio, and of instant-ngp and NeRFCapture."""
_OTHER_LENS = re.compile(
    r"(is_)?(equirectangular|latlong|orthographic|ftheta)\w*|ftheta_\w+|lens|xi|k[5-9]|skew"
)
"""Names of lenses that are neither a pinhole nor OpenCV's fisheye."""

LOOKS_FOR = "transforms.json"


def recognise(path: Path) -> bool:
    """The file, or a folder that holds it."""
    return _file(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """Frames of a transforms.json, in natural order of their names (module docstring)."""
    file = _file(path)
    if file is None:
        raise SequenceError(f"{path} holds no transforms.json; expected that file or its folder")
    values = read_object(file, "nerfstudio transforms")
    frames = _complete(values["frames"], file)
    frames = sorted(frames, key=lambda f: natural_order(Path(f["file_path"])))
    if not options.depth and not any(key in f for f in frames for key in _DEPTH_KEYS):
        raise SequenceError(
            f"{file} has no {' or '.join(_DEPTH_KEYS)}; "
            "RGB-D mapping needs depth: give its folder with --depth, or add the key"
        )
    for frame in frames:
        check_poses_as_read(
            values | frame,
            file,
            unit_is_given=bool(options.scale),
            camera_is_given=bool(options.intrinsics),
        )
    world, notes = _undo(values, file)
    meanings = [meaning_of_depth(values | frame, file) for frame in frames]
    along_ray = meanings[0].along_ray
    if any(meaning.along_ray != along_ray for meaning in meanings):
        raise SequenceError(
            f"{file}: depth of some frames is along the ray, of others along the axis; expected "
            "one kind"
        )
    scales = [options.depth_scale or meaning.per_metre for meaning in meanings]
    notes += notes_on_unused(values, frames)
    notes += [note_on_depth(scales, along_ray=along_ray)]
    if not options.intrinsics and any(
        "fl_x" in entry and not {"w", "h"} <= entry.keys() for entry in (values | f for f in frames)
    ):
        notes.append("there is no w and h: the focal length is taken as that of the images")
    keys = ("file_path", *_DEPTH_KEYS)
    outside_note = told_outside(
        file.parent,
        (file.parent / frame[key] for frame in frames for key in keys if key in frame),
    )

    def recorded_frames() -> Iterator[RecordedFrame]:
        for frame, scale in zip(frames, scales, strict=True):
            colour = _image(file.parent / frame["file_path"])
            yield RecordedFrame(
                source=str(colour),
                time_s=_time(frame),
                model=None if options.intrinsics else _model(values | frame, file, colour),
                T_WC=_pose(frame, world, file),
                load=partial(load_pair, colour, _depth(frame, file, colour, options), scale),
            )

    return Recording(
        name=str(file),
        frames=recorded_frames,
        n_frames=len(frames),
        depth_scale=scales[0],
        depth_along_ray=along_ray,
        notes=(*notes, *filter(None, [outside_note])),
    )


def _complete(frames: list[dict[str, Any]], file: Path) -> list[dict[str, Any]]:
    """The frames. Raises ``SequenceError`` where one lacks its image or its pose."""
    for number_of_frame, frame in enumerate(frames):
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                raise SequenceError(
                    f"{file}: frame {number_of_frame} has no {key}, but {shown(', '.join(frame))}; "
                    "expected file_path, the colour image, and transform_matrix, its "
                    "camera-to-world pose, for each frame"
                )
    return frames


def _file(path: Path) -> Path | None:
    if path.is_file():
        return (
            path if path.suffix.lower() == ".json" and path.name.startswith("transforms") else None
        )
    return path / "transforms.json" if (path / "transforms.json").is_file() else None


def _undo(
    values: dict[str, Any],
    file: Path,
) -> tuple[Float[Tensor, "4 4"], list[str]]:
    """Matrix that undoes the motion and scaling of the world: S^-1 then A^-1."""
    notes = []
    inverse = torch.eye(4, dtype=torch.float64)
    if "applied_transform" in values:
        A = _matrix(values["applied_transform"], f"{file}: applied_transform")
        if abs(float(torch.linalg.det(A[:3, :3])) - 1) > 1e-3:
            raise SequenceError(
                f"{file}: applied_transform must be a rotation and a translation; it scales or "
                "mirrors"
            )
        inverse = se3.inverse(A)
        notes.append("applied_transform was undone")
    applied_scale = number(values, "applied_scale", 1.0, file)
    if applied_scale != 1.0:
        inverse = inverse @ torch.diag(
            torch.tensor([1 / applied_scale] * 3 + [1.0], dtype=torch.float64)
        )
        notes.append(f"applied_scale {applied_scale:g} was undone")
    return inverse, notes


def _pose(
    frame: dict[str, Any],
    world: Float[Tensor, "4 4"],
    file: Path,
) -> Float[Tensor, "4 4"]:
    T = _matrix(frame["transform_matrix"], f"{file}: transform_matrix of {frame['file_path']}")
    T_world = world @ T
    T_world[:3, :3] = world[:3, :3] / torch.linalg.det(world[:3, :3]).abs() ** (1 / 3) @ T[:3, :3]
    return T_world @ GL_TO_CV


def _matrix(rows: Any, source: str) -> Float[Tensor, "4 4"]:
    with parsing(source, "4x4 or 3x4 numbers"):
        matrix = torch.tensor(rows, dtype=torch.float64)
    if matrix.ndim != 2 or tuple(matrix.shape) not in ((4, 4), (3, 4)):
        raise SequenceError(f"{source} must be 4x4 or 3x4 numbers, got {list(matrix.shape)}")
    check_last_rows(matrix[None], source)
    return torch.cat([matrix[:3], torch.eye(4, dtype=matrix.dtype)[3:]])


def _model(values: dict[str, Any], file: Path, colour: Path) -> CameraModel:
    """Camera of a frame: its own values where it has them, else the global ones."""
    name = values.get("camera_model", "OPENCV")
    if name not in _MODELS:
        raise SequenceError(
            f"{file}: cannot undistort camera_model {shown(name)}; known: {', '.join(_MODELS)}"
        )
    source = f"{file}: the camera of {colour.name}"
    other = next(
        (key for key, value in values.items() if value and _OTHER_LENS.fullmatch(key)), None
    )
    if other is not None:
        raise SequenceError(
            f"{source} has {other}, a lens that cannot be undistorted here; undistort the images "
            "first"
        )
    if "w" in values and "h" in values:
        width, height = (int(number(values, key, 0, source)) for key in ("w", "h"))
    else:
        height, width = read_rgb(colour).shape[:2]
    with parsing(source, "fl_x (or camera_angle_x), cx and cy as numbers"):
        if "fl_x" in values:
            fx = float(values["fl_x"])
            fy = float(values.get("fl_y", values["fl_x"]))
        else:
            fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
            fy = (
                0.5 * height / math.tan(0.5 * float(values["camera_angle_y"]))
                if "camera_angle_y" in values
                else fx
            )
        cx, cy = (float(values.get(k, half)) for k, half in (("cx", width / 2), ("cy", height / 2)))
        k = [float(values.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2", "k3", "k4")]
    fisheye = name == "OPENCV_FISHEYE" or bool(values.get("is_fisheye"))
    if not fisheye and k[5]:  # a numerator term in nerfstudio, a denominator term in OpenCV
        raise SequenceError(
            f"{source} has k4 = {k[5]:g}, which only a fisheye may have here; undistort the images "
            "first"
        )
    distortion = (k[0], k[1], k[4], k[5]) if fisheye else tuple(k[:5])
    return model_of(
        [fx, fy, cx, cy],
        (width, height),
        source,
        centre=0.5,
        distortion=distortion,
        fisheye=fisheye,
    )


def _image(path: Path) -> Path:
    """The image; some programs write its name without the suffix."""
    candidates = (Path(f"{path}{s}") for s in ("", ".png", ".jpg", ".jpeg"))
    return next((p for p in candidates if is_file(p)), path)


def _depth(
    frame: dict[str, Any],
    file: Path,
    colour: Path,
    options: ConvertOptions,
) -> Path:
    if options.depth:
        return find_depth(Path(options.depth), colour.stem)
    name = next((frame[key] for key in _DEPTH_KEYS if key in frame), None)
    if name is None:
        return file.parent / f"depth of {colour.name}, which the file does not name"
    return _image(file.parent / name)


def _time(frame: dict[str, Any]) -> float | None:
    value = frame.get("timestamp", frame.get("time"))
    return None if value is None else float(value)
