"""ICL-NUIM: rgb/ and depth/ in TUM's layout with ``*.gt.freiburg``.

The camera's fy is -480: its axes are x right, y up, z forward, a left-handed frame, and so is its world. With
M = diag(1, -1, 1) the right-handed pose is M T M, and fy becomes +480; without the sign, or with only the camera
flipped, the map is mirrored or torn. Depth PNGs hold z-depth, 5000 per metre. Pixel centres at integers.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from ....data.lens import CameraModel
from ....data.recorded.files import images_in, pair_by_stem
from ....data.sequence import SequenceError, SequenceNotFoundError
from ....types import Camera
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair
from ..trajectory import read_trajectory

_MODEL = CameraModel(Camera(width=640, height=480, fx=481.2, fy=480.0, cx=319.5 + 0.5, cy=239.5 + 0.5))
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
_DEPTH_SCALE = 5000.0

LOOKS_FOR = "a trajectory *.gt.freiburg"


def recognise(path: Path) -> bool:
    """A ground truth of ICL-NUIM."""
    return path.is_dir() and _ground_truth(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """A trajectory of ICL-NUIM (module docstring)."""
    if not path.is_dir():
        raise SequenceNotFoundError(f"{path} is not a folder; expected one with rgb/, depth/ and *.gt.freiburg")
    images = images_in(path / "rgb")
    if wrong := [image for image in images if not image.stem.isdigit()]:
        raise SequenceError(f"{wrong[0]} is not named by its frame number; expected 0.png")
    depths = pair_by_stem(images, images_in(path / "depth"))
    file = _ground_truth(path) or _ground_truth(path.parent)
    poses = read_trajectory(file, time_unit="s", max_gap_s=0.0) if file else None  # numbers of frames, not times
    scale = options.depth_scale or _DEPTH_SCALE

    def recorded_frames() -> Iterator[RecordedFrame]:
        for colour, depth in zip(images, depths, strict=True):
            number = int(colour.stem)
            T = poses.pose_at(float(number)) if poses else None
            yield RecordedFrame(
                source=str(colour),
                time_s=number / 30,
                model=_MODEL,
                T_WC=None if T is None else _MIRROR @ T @ _MIRROR,
                load=partial(load_pair, colour, depth, scale),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(images),
        depth_scale=scale,
        has_poses=poses is not None,
        notes=("y was mirrored in the world and the cameras (ICL-NUIM is left-handed, its fy is -480)",),
    )


def _ground_truth(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.gt.freiburg"))), None)
