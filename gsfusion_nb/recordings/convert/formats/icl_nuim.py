"""ICL-NUIM: rgb/ and depth/ in TUM's layout with ``*.gt.freiburg``, or POV-Ray's scene_00_0000.png + .depth.

The camera's fy is -480: its axes are x right, y up, z forward, a left-handed frame, and so is its world. With
M = diag(1, -1, 1) the right-handed pose is M T M, and fy becomes +480; without the sign, or with only the camera
flipped, the map is mirrored or torn. Depth PNGs hold z-depth, 5000 per metre. The .depth files hold the distance along
each ray as text, row by row: z = distance / sqrt(1 + x^2 + y^2); metres in the living room. Pixel centres at integers.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.images import read_image_bytes
from ....data.recorded.poses import matrices
from ....data.sequence import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import read_text
from ....types import Camera
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, load_pair, metres, with_colour

_WIDTH, _HEIGHT = 640, 480
_MODEL = CameraModel(Camera(width=_WIDTH, height=_HEIGHT, fx=481.2, fy=480.0, cx=319.5 + 0.5, cy=239.5 + 0.5))
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
_DEPTH_SCALE = 5000.0


def recognise(path: Path) -> bool:
    """A ground truth of ICL-NUIM, or POV-Ray depth."""
    return path.is_dir() and (_ground_truth(path) is not None or next(path.glob("*.depth"), None) is not None)


def read(path: Path, options: ConvertOptions) -> Recording:
    """A trajectory of ICL-NUIM (module docstring)."""
    if not path.is_dir():
        raise SequenceNotFoundError(f"{path} is not a folder; expected one with rgb/, depth/ and *.gt.freiburg")
    pov = sorted(path.glob("*.depth"))
    pairs = _pov_pairs(pov) if pov else _png_pairs(path)
    file = _ground_truth(path) or _ground_truth(path.parent)
    poses = read_ground_truth(file) if file else {}
    scale = options.depth_scale or (1.0 if pov else _DEPTH_SCALE)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for number, (colour, depth) in pairs.items():
            T = poses.get(number)
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
        has_poses=bool(poses),
        notes=("y was mirrored in the world and the cameras (ICL-NUIM is left-handed, its fy is -480)",),
    )


def read_ground_truth(path: Path) -> dict[int, Float[Tensor, "4 4"]]:
    """Poses by frame number of lines "number tx ty tz qx qy qz qw", left-handed as stored, float64."""
    poses = {}
    for number, line in enumerate(read_text(path, "lines 'frame tx ty tz qx qy qz qw'").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            frame, row = round(float(words[0])), torch.tensor([float(w) for w in words[1:]], dtype=torch.float64)
        except (ValueError, OverflowError):
            frame, row = 0, torch.zeros(0)
        if len(row) != 7 or frame in poses:
            twice = ", each frame once" if len(row) == 7 else ""
            raise SequenceError(f"{path} line {number} must be 'frame tx ty tz qx qy qz qw'{twice}, got {shown(line)}")
        poses[frame] = matrices(row[None])[0]
    return poses


def _ground_truth(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.gt.freiburg"))), None)


def _png_pairs(path: Path) -> dict[int, tuple[Path, Path]]:
    """Colour and depth by frame number, which is their name: 0.png, 1.png, ..."""
    for name in ("rgb", "depth"):
        if not (path / name).is_dir():
            raise SequenceNotFoundError(f"{path} lacks {name}/; expected rgb/ and depth/ beside *.gt.freiburg")
    pairs = {}
    for colour in images_in(path / "rgb"):
        if not colour.stem.isdigit():
            raise SequenceError(f"{colour} is not named by its frame number; expected 0.png, 1.png, ...")
        pairs[int(colour.stem)] = (colour, path / "depth" / f"{colour.stem}.png")
    return pairs


def _pov_pairs(files: list[Path]) -> dict[int, tuple[Path, Path]]:
    """Colour and depth by the number at the end of scene_00_0000."""
    pairs = {}
    for depth in files:
        number = depth.stem.split("_")[-1]
        if not number.isdigit():
            raise SequenceError(f"{depth} is not named as POV-Ray's frames; expected scene_00_0000.depth and so on")
        pairs[int(number)] = (depth.with_suffix(".png"), depth)
    return pairs


def _load_pov(colour: Path, depth: Path, scale: float) -> RgbdImages:
    words = read_image_bytes(depth, "depth").split()
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        raise BadFrameError(f"{depth} must hold distances as text, row by row") from None
    if len(values) != _WIDTH * _HEIGHT:
        raise BadFrameError(f"{depth} holds {len(values)} numbers; expected {_WIDTH * _HEIGHT}, one per pixel")
    return with_colour(read_image_bytes(colour, "colour"), str(colour), metres(values.reshape(_HEIGHT, _WIDTH), scale))
