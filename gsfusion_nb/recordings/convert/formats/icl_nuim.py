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
from ....data.recorded.files import images_in
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
    pairs = _pairs(path)
    file = _ground_truth(path) or _ground_truth(path.parent)
    poses = read_trajectory(file, time_unit="s", max_gap_s=0.0) if file else None  # numbers of frames, not times
    scale = options.depth_scale or _DEPTH_SCALE

    def recorded_frames() -> Iterator[RecordedFrame]:
        for number, (colour, depth) in pairs.items():
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
        n_frames=len(pairs),
        depth_scale=scale,
        has_poses=poses is not None,
        notes=("y was mirrored in the world and the cameras (ICL-NUIM is left-handed, its fy is -480)",),
    )


def _ground_truth(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.gt.freiburg"))), None)


def _pairs(path: Path) -> dict[int, tuple[Path, Path]]:
    """Colour and depth by frame number, the name of rgb/0.png."""
    for name in ("rgb", "depth"):
        if not (path / name).is_dir():
            raise SequenceNotFoundError(f"{path} lacks {name}/; expected rgb/ and depth/ beside *.gt.freiburg")
    images = images_in(path / "rgb")
    for image in images:
        if not image.stem.isdigit():
            raise SequenceError(f"{image} is not named by its frame number; expected 0.png")
    return {int(image.stem): (image, path / "depth" / f"{image.stem}.png") for image in images}
