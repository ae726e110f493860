"""Neural RGB-D's scenes: ``images/img0.png``, ``depth/depth0.png``, ``poses.txt`` and
``focal.txt``.

Poses are camera-to-world with OpenGL axes (y up, z backward), four rows for each image, NaN where
there is none. Depth is in millimetres. There is one focal length in pixels, and the centre is that
of the image.
"""

from dataclasses import replace
from pathlib import Path

from ....data.recorded.files import images_in
from ....data.recorded.poses import GL_TO_CV, image_number, read_rows
from ....errors import SequenceError
from ..depth_files import DEPTH_SUFFIXES
from ..intrinsics import read_intrinsics
from ..recording import ConvertOptions, Recording
from .image_recording import recording_of, size_of_colour
from .pairing import FrameFiles, paired_by_name

_POSES = ("poses.txt", "trainval_poses.txt")
_DEPTH = "depth"

LOOKS_FOR = "images/, depth/, focal.txt and poses.txt"


def recognise(path: Path) -> bool:
    """A scene of Neural RGB-D."""
    has_folders = (path / "images").is_dir() and (path / _DEPTH).is_dir()
    return (
        has_folders
        and (path / "focal.txt").is_file()
        and any((path / name).is_file() for name in _POSES)
    )


def read(path: Path, options: ConvertOptions) -> Recording:
    """A scene of Neural RGB-D (module docstring); ``options.depth`` may be another of its folders
    of depth.

    Raises:
        SequenceError: an image without four rows of a pose.
    """
    colour = images_in(path / "images")
    depth_folder = path / options.depth if (path / options.depth).is_dir() else Path(options.depth)
    depth = images_in(depth_folder if options.depth else path / _DEPTH, DEPTH_SUFFIXES)
    pairs = paired_by_name(path, colour, depth)
    file = next(path / name for name in _POSES if (path / name).is_file())
    poses = read_rows(file, 4, "four rows of a camera-to-world matrix for each image")
    numbers = [image_number(rgb) for rgb, _ in pairs]
    places = [place if n is None else n for place, n in enumerate(numbers)]
    if len(poses) % 4 or 4 * max(places) >= len(poses):
        raise SequenceError(
            f"{file} holds {len(poses)} rows; expected 4 for each image up to {pairs[-1][0].name}"
        )
    T_WC = poses.reshape(-1, 4, 4) @ GL_TO_CV
    note = (
        "Neural RGB-D: poses were turned from OpenGL's axes (y up, z backward); depth read as "
        "1000 per metre"
    )
    return recording_of(
        path,
        FrameFiles(pairs, None, notes=(note,)),
        replace(options, depth_scale=options.depth_scale or 1000.0),
        model=read_intrinsics(str(path / "focal.txt"), size_of_colour(pairs[0][0]), centre=0.5),
        T_WC=[T_WC[place] for place in places],
    )
