"""Replica as rendered for NICE-SLAM (Sucar et al. 2021, Zhu et al. 2022): 1200x680, perfect depth
and poses.

office0/
  results/frame000000.jpg ...    8-bit colour
  results/depth000000.png ...    16-bit depth, 6553.5 per metre
  traj.txt                       line n: frame n's camera-to-world matrix, 16 row-major numbers
cam_params.json                  beside traj.txt or in the folder above
"""

import re
from pathlib import Path

from ...errors import SequenceError
from ...files import read_object
from ...types import Camera
from ..recorded.files import camera, given_name, images_in, numbers, require
from ..recorded.poses import read_rows
from ..recorded.recorded_sequence import Layout, RecordedSequence

LOOKS_FOR = ("results/", "traj.txt")
DEPTH_SCALE = 6553.5
DEFAULT_CAMERA = Camera(
    width=1200,
    height=680,
    fx=600.0,
    fy=600.0,
    cx=600.0,
    cy=340.0,
)
"""600, 600, 599.5, 339.5 as published, pixel centres at integers there."""

_KEYS = ("w", "h", "fx", "fy", "cx", "cy")


def replica(path: str | Path) -> RecordedSequence:
    """Read a Replica scene in NICE-SLAM's rendering (module docstring).

    Depth scale: ``scale`` of ``cam_params.json``, else 6553.5. Poses: camera-to-world, OpenCV axes.
    Pixel centres: integers in the file, so 0.5 is added to ``cx`` and ``cy``. Without
    ``cam_params.json`` the camera is 600, 600, 599.5, 339.5 at 1200x680. The number in an image's
    name is its line in ``traj.txt``, so a copy with only some of the frames can be read too.

    Args:
        path: Folder of the scene.

    Raises:
        SequenceNotFoundError: the folder or one of its parts is missing.
        SequenceError: no frames, or fewer poses than frames.
    """
    root = Path(path)
    require(root, LOOKS_FOR, "replica")
    frames = [p for p in images_in(root / "results") if re.fullmatch(r"frame\d+", p.stem)]
    order = [int(p.stem.removeprefix("frame")) for p in frames]
    if not frames:
        raise SequenceError(
            f"{root / 'results'} holds no images frame000000 and so on; expected those of a scene"
        )
    poses_file = root / "traj.txt"
    poses = read_rows(
        poses_file, 16, "16 row-major numbers of a camera-to-world pose per line"
    ).reshape(-1, 4, 4)
    if order[-1] >= len(poses):
        raise SequenceError(
            f"{poses_file} holds {len(poses)} poses; expected at least {order[-1] + 1}, up to "
            f"{frames[-1]}"
        )
    scene_camera, depth_scale = _calibration(root)
    return RecordedSequence(
        name=given_name(root),
        camera=scene_camera,
        rgb_files=frames,
        depth_files=[p.with_name(p.stem.replace("frame", "depth") + ".png") for p in frames],
        timestamps_s=[n / 30.0 for n in order],
        poses=poses[order],
        pose_sources=[f"{poses_file} pose {n}" for n in order],
        depth_scale=depth_scale,
    )


def _calibration(root: Path) -> tuple[Camera, float]:
    """Camera, and the stored depth value of one metre."""
    for file in (root / "cam_params.json", root.resolve().parent / "cam_params.json"):
        if file.is_file():
            values = read_object(file, "Replica's camera").get("camera")
            if not isinstance(values, dict):
                raise SequenceError(
                    f"{file} lacks the key camera; expected an object with {', '.join(_KEYS)}, "
                    "scale"
                )
            return camera(values, _KEYS, file, shift=0.5), numbers(values, ("scale",), file)[
                "scale"
            ]
    return DEFAULT_CAMERA, DEPTH_SCALE


LAYOUT = Layout(read=replica, looks_for=LOOKS_FOR)
