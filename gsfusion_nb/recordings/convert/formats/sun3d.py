"""SUN3D: ``image/``, ``depth/``, ``intrinsics.txt`` and ``extrinsics/``.

The 16 bits of depth are turned to the left by 3, so that read as they are the values are eight
times the millimetres. Names are a number and microseconds. The newest file of ``extrinsics/`` holds
three rows of a camera-to-world matrix for each colour image, OpenCV axes, metres. Pixel centres at
integers. (``depthRead.m`` of SUN3Dsfm.)
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.images import decode_depth, read_image_bytes
from ....data.recorded.poses import read_rows
from ....data.recorded.times import associate
from ....errors import SequenceError
from ..depth_files import metres
from ..intrinsics import read_intrinsics
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, with_colour
from .image_recording import size_of_colour

_TURNED_BITS = 3
_MAX_TIME_DIFFERENCE_S = 0.02

LOOKS_FOR = "image/, depth/, intrinsics.txt and extrinsics/"


def recognise(path: Path) -> bool:
    """A folder of SUN3D."""
    folders = (path / "image", path / "depth", path / "extrinsics")
    return all(folder.is_dir() for folder in folders) and (path / "intrinsics.txt").is_file()


def read(path: Path, options: ConvertOptions) -> Recording:
    """A place of SUN3D (module docstring).

    Raises:
        SequenceError: names without a time, no depth near the colour images, or another number of
            poses.
    """
    colour = images_in(path / "image")
    depth = images_in(path / "depth")
    colour_s = [_seconds(file) for file in colour]
    depth_s = [_seconds(file) for file in depth]
    pairs = associate(depth_s, colour_s, max_difference_s=_MAX_TIME_DIFFERENCE_S)
    if not pairs:
        raise SequenceError(
            f"{path}: none of {len(depth)} depth images has a colour image within "
            f"{_MAX_TIME_DIFFERENCE_S} s"
        )
    poses_file = max((path / "extrinsics").glob("*.txt"), default=None)
    T_WC = None if poses_file is None else _poses(poses_file, len(colour))
    scale = options.depth_scale or 1000.0

    def recorded_frames() -> Iterator[RecordedFrame]:
        for d, c in pairs:
            yield RecordedFrame(
                source=str(colour[c]),
                time_s=colour_s[c],
                depth_time_s=depth_s[d],
                model=None if options.intrinsics else _model(path, colour[c]),
                T_WC=None if T_WC is None else T_WC[c],
                load=partial(_load, colour[c], depth[d], scale),
            )

    n_unpaired = len(depth) - len(pairs)
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(pairs),
        depth_scale=scale,
        has_poses=T_WC is not None,
        dropped={"no colour image near in time": n_unpaired} if n_unpaired else {},
        notes=(
            f"SUN3D: the bits of depth were turned back by {_TURNED_BITS}; poses of "
            f"{poses_file or 'no file'}",
        ),
    )


def _seconds(file: Path) -> float:
    """When an image was taken, from a name such as 0000001-000000033369.jpg."""
    match = re.fullmatch(r"\d+-(\d+)", file.stem)
    if match is None:
        raise SequenceError(
            f"{file} is not named as in SUN3D; expected a number and microseconds: "
            "0000001-000000033369"
        )
    return int(match[1]) / 1e6


def _poses(file: Path, n_images: int) -> torch.Tensor:
    rows = read_rows(file, 4, "three rows of a camera-to-world matrix for each image")
    if len(rows) != 3 * n_images:
        raise SequenceError(
            f"{file} holds {len(rows)} rows; expected 3 for each of {n_images} images in image/"
        )
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rows.dtype).expand(n_images, 1, 4)
    return torch.cat([rows.reshape(n_images, 3, 4), last], 1)


def _model(path: Path, colour: Path) -> CameraModel:
    return read_intrinsics(str(path / "intrinsics.txt"), size_of_colour(colour))


def _load(colour: Path, depth: Path, scale: float) -> RgbdImages:
    stored_values = decode_depth(depth, (np.uint16,))
    raw = (stored_values >> _TURNED_BITS) | (stored_values << (16 - _TURNED_BITS))
    return with_colour(read_image_bytes(colour, "colour"), str(colour), metres(raw, scale))
