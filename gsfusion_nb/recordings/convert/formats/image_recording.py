"""What a folder tells beside its images: the cameras, where depth stands, the unit of depth, and
the poses."""

import contextlib
import itertools
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.readers.seven_scenes import calibrated_folders
from ....data.readers.tum import LENSES, benchmark_camera
from ....data.recorded.files import calibration_in, calibrations_in, first_of, told_outside
from ....data.recorded.images import read_rgb
from ....errors import BadFrameError, SequenceError
from ....files import is_file
from ..calibration_tree import Tree, tree_of_file
from ..confidence import confidence_of
from ..depth_camera import (
    depth_camera_beside,
    notes_on_a_second_camera,
    poses_of_a_robot,
    told_unit,
)
from ..depth_files import check_exr, read_depth_file
from ..depth_unit import find_depth_unit, some_depths
from ..focal_length import estimated_model
from ..intrinsics import read_intrinsics
from ..recording import ConvertOptions, DepthUnit, RecordedFrame, Recording, load_pair
from .pairing import FrameFiles

_POSES = (
    "groundtruth*",
    "poses.*",
    "pose.*",
    "*poses.*",
    "odometry.csv",
    "traj*",
    "*.traj",
    "CameraTrajectory.txt",
    "pos.*",
    "pose",
    "poses",
)


def recording_of(
    path: Path,
    frame_files: FrameFiles,
    options: ConvertOptions,
    *,
    model: CameraModel | None = None,
    T_WC: Sequence[Float[Tensor, "4 4"] | None] = (),
) -> Recording:
    """The recording of pairs of images, with the camera, the poses and the unit of depth that the
    folder tells.

    Args:
        path, frame_files, options: The folder, its frames, and how to read them.
        model: The camera, if the folder tells none.
        T_WC: Pose of each frame, None where it is unknown; by default those of a file in the
            folder.
    """
    check_exr(frame_files.pairs[0][1])
    file = _calibration(path, options)
    tree = tree_of_file(file) if file is not None else {}
    unit, about_unit = _unit(path, frame_files, tree, str(file), options)
    scale = options.depth_scale if unit is None else unit.scale
    of_folder, about = _model(path, frame_files, scale, options)
    model = of_folder or model
    depth_model, T_colour_depth, about_depth = depth_camera_beside(
        path, tree, str(file), _size_of_depth(frame_files)
    )
    if depth_model is None and T_colour_depth is None and not _says_where_depth_is(options):
        about_depth += notes_on_a_second_camera(tree, str(file))
    sure = confidence_of(frame_files.pairs[0][1], options.confidence)
    if sure is not None:
        about_depth.append(
            f"depth of confidence {options.confidence} and above, by {sure.file.parent} "
            "(--confidence)"
        )
    images = frame_files.pairs[0][0].parent
    # folders have no suffix
    poses = str(first_of(path, _POSES, (".txt", ".csv", ".npy", ".traj", "")) or "")
    poses = poses or str(images) * any(images.glob("*pose.txt"))
    if not options.poses and not T_WC and (pose_advice := poses_of_a_robot(Path(poses), tree)):
        raise SequenceError(pose_advice)
    outside_note = told_outside(path, itertools.chain(*frame_files.pairs))
    unknown = [None] * len(frame_files.pairs)
    frames = [
        *zip(
            frame_files.pairs,
            frame_files.times_s or unknown,
            frame_files.depth_times_s or unknown,
            T_WC or unknown,
            strict=True,
        )
    ]

    def recorded_frames() -> Iterator[RecordedFrame]:
        for (colour, depth), time_s, depth_time_s, T in frames:
            yield RecordedFrame(
                source=str(colour),
                time_s=time_s,
                depth_time_s=depth_time_s,
                model=model,
                depth_model=depth_model,
                T_colour_depth=T_colour_depth,
                T_WC=T,
                load=partial(
                    load_pair, colour, depth, scale, confidence_of(depth, options.confidence)
                ),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(frame_files.pairs),
        depth_scale=scale,
        unit=unit,
        has_poses=bool(poses or T_WC),
        poses_file="" if T_WC else poses,
        dropped=frame_files.dropped,
        notes=(
            *about,
            *about_depth,
            *frame_files.notes,
            *about_unit,
            *filter(None, [outside_note]),
        ),
    )


def _says_where_depth_is(options: ConvertOptions) -> bool:
    return bool(options.depth_intrinsics or options.T_colour_depth)


def _calibration(path: Path, options: ConvertOptions) -> Path | None:
    """The file with the camera: that of the options, or one in the folder."""
    if not options.intrinsics:
        return calibration_in(*calibrated_folders(path))
    given_file = Path(options.intrinsics)
    return given_file if is_file(given_file) else None


def _unit(
    path: Path, frame_files: FrameFiles, tree: Tree, source: str, options: ConvertOptions
) -> tuple[DepthUnit | None, list[str]]:
    """The unit of depth that the calibration tells, or a guess; None if the options say it. And
    notes."""
    if options.depth_scale:
        return None, []
    samples = some_depths([depth for _, depth in frame_files.pairs])
    stated_unit, notes = told_unit(tree, source, samples)
    unit = stated_unit or find_depth_unit(path, samples)
    return unit, notes if unit.is_guess else [*notes, unit.sentence]


def _size_of_depth(frame_files: FrameFiles) -> tuple[int, int]:
    """Width and height of the first depth image that is there."""
    depth = next(
        (depth for _, depth in frame_files.pairs if is_file(depth)),
        frame_files.pairs[0][1],
    )
    height, width = read_depth_file(depth, 1.0).shape
    return width, height


def size_of_colour(colour: Path) -> tuple[int, int]:
    """Width and height of a colour image. Raises ``BadFrameError`` if it cannot be read."""
    height, width = read_rgb(colour).shape[:2]
    return width, height


def _model(
    path: Path, frame_files: FrameFiles, scale: float, options: ConvertOptions
) -> tuple[CameraModel | None, list[str]]:
    """Camera of the options, of a calibration file or of the benchmark, if any, and a sentence that
    names it."""
    file = options.intrinsics or str(calibration_in(*calibrated_folders(path)) or "")
    if options.intrinsics == "estimate":
        model, sentence = estimated_model(frame_files.pairs, scale)
        return model, [sentence]
    lens_name = benchmark_camera(path)
    height, width = next(_sizes(frame_files.pairs), (0, 0)) if file or lens_name else (0, 0)
    if not height:
        return None, []
    if file:
        centre = options.pixel_centre if options.intrinsics else 0.0
        model = read_intrinsics(file, (width, height), centre=centre)
        others = [] if options.intrinsics else _other_cameras(path, Path(file), model)
        return model, [f"intrinsics from {file}", *others]
    if (LENSES[lens_name].camera.width, LENSES[lens_name].camera.height) != (width, height):
        return None, []
    return LENSES[lens_name], [f"intrinsics of the TUM benchmark's {lens_name}"]


_OF_OTHER_THINGS = re.compile(r"(?i)depth|(^|[._-])(ir|right|gyro|imu)([._-]|$)")
"""In the name of a calibration that is not that of the colour images."""

_DIFFERENT = 0.01
"""Intrinsics that differ by more are those of two cameras."""


def _other_cameras(path: Path, used_file: Path, model: CameraModel) -> list[str]:
    """What is said about another calibration in the folder that gives another camera."""
    for file in dict.fromkeys(calibrations_in(*calibrated_folders(path))):
        is_of_images = not _OF_OTHER_THINGS.search(file.name) and file.suffix != ".pincam"
        if file.resolve() == used_file.resolve() or not is_of_images:
            continue
        with contextlib.suppress(SequenceError):
            other = read_intrinsics(str(file), (model.camera.width, model.camera.height)).camera
            pairs = [
                (getattr(other, n), getattr(model.camera, n)) for n in ("fx", "fy", "cx", "cy")
            ]
            if any(abs(a / b - 1) > _DIFFERENT for a, b in pairs if b):
                return [f"{file} gives other intrinsics, fx {other.fx:g}, and is not used"]
    return []


def _sizes(pairs: list[tuple[Path, Path]]) -> Iterator[tuple[int, ...]]:
    """Height and width of each colour image that can be read."""
    for colour, _ in pairs:
        with contextlib.suppress(BadFrameError):
            yield read_rgb(colour).shape[:2]
