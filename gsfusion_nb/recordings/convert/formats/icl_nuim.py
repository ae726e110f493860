"""ICL-NUIM: rgb/ and depth/ in TUM's layout with ``*.gt.freiburg``, or POV-Ray's scene_00_0000.png
+ .depth.

The camera's fy is -480: its axes are x right, y up, z forward, a left-handed frame, and so is its
world. With M = diag(1, -1, 1) the right-handed pose is M T M, and fy becomes +480; without the
sign, or with only the camera flipped, the map is mirrored or torn. Depth PNGs hold z-depth, 5000
per metre. The .depth files hold the distance along each ray as text, row by row: z = distance /
sqrt(1 + x^2 + y^2); metres in the living room. Pixel centres at integers.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.images import read_image_bytes
from ....errors import SequenceError, SequenceNotFoundError
from ....types import Camera
from ..depth_files import metres
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, load_pair, with_colour
from ..trajectory import read_trajectory

_WIDTH = 640
_HEIGHT = 480
_MODEL = CameraModel(
    Camera(
        width=_WIDTH,
        height=_HEIGHT,
        fx=481.2,
        fy=480.0,
        cx=319.5 + 0.5,
        cy=239.5 + 0.5,
    )
)
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
_DEPTH_SCALE = 5000.0

LOOKS_FOR = "a trajectory *.gt.freiburg, or *.depth files"


def recognise(path: Path) -> bool:
    """A ground truth of ICL-NUIM, or POV-Ray depth."""
    return path.is_dir() and (
        _ground_truth(path) is not None or next(path.glob("*.depth"), None) is not None
    )


def read(path: Path, options: ConvertOptions) -> Recording:
    """A trajectory of ICL-NUIM (module docstring)."""
    if not path.is_dir():
        raise SequenceNotFoundError(
            f"{path} is not a folder; expected one with rgb/, depth/ and *.gt.freiburg"
        )
    pov = sorted(path.glob("*.depth"))
    pairs = _pairs(path, pov)
    file = _ground_truth(path) or _ground_truth(path.parent)
    # numbers of frames, not times
    poses = read_trajectory(file, time_unit="s", max_gap_s=0.0) if file else None
    scale = options.depth_scale or (1.0 if pov else _DEPTH_SCALE)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for number, (colour, depth) in pairs.items():
            T = poses.pose_at(float(number)) if poses else None
            yield RecordedFrame(
                source=str(colour),
                time_s=number / 30,
                model=_MODEL,
                T_WC=None if T is None else _MIRROR @ T @ _MIRROR,
                load=partial(_load_pov if pov else load_pair, colour, depth, scale),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(pairs),
        depth_scale=scale,
        depth_along_ray=bool(pov),
        has_poses=poses is not None,
        notes=(
            "y was mirrored in the world and the cameras (ICL-NUIM is left-handed, its fy is -480)",
            f"depth read as {scale:g} per metre; times are frame numbers at 30 Hz",
        ),
    )


def _ground_truth(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.gt.freiburg"))), None)


def _pairs(
    path: Path,
    pov: list[Path],
) -> dict[int, tuple[Path, Path]]:
    """Colour and depth by frame number: that at the end of scene_00_0000.depth, or the name of
    rgb/0.png."""
    if pov:
        pairs = [(depth.with_suffix(".png"), depth) for depth in pov]
    else:
        for name in ("rgb", "depth"):
            if not (path / name).is_dir():
                raise SequenceNotFoundError(
                    f"{path} lacks {name}/; expected rgb/ and depth/ beside *.gt.freiburg"
                )
        pairs = [
            (colour, path / "depth" / f"{colour.stem}.png") for colour in images_in(path / "rgb")
        ]
    for colour, _ in pairs:
        if not colour.stem.split("_")[-1].isdigit():
            raise SequenceError(
                f"{colour} is not named by its frame number; expected 0.png, or scene_00_0000.png"
            )
    return {int(colour.stem.split("_")[-1]): (colour, depth) for colour, depth in pairs}


def _load_pov(colour: Path, depth: Path, scale: float) -> RgbdImages:
    values = np.array(read_image_bytes(depth, "depth").split(), dtype=np.float64).reshape(
        _HEIGHT, _WIDTH
    )
    return with_colour(read_image_bytes(colour, "colour"), str(colour), metres(values, scale))
