"""TartanAir and TartanAir V2, rendered with AirSim: ``image_left/``, ``depth_left/``,
``pose_left.txt``.

In V2 the cameras have names such as ``lcam_front``. Poses ``tx ty tz qx qy qz qw`` are
camera-to-world in AirSim's axes (x forward, y right, z down), for the camera and the world. Depth
is z-depth in metres, NumPy or, in V2, float32 in the four channels of a PNG. The field of view is
90 degrees: fx = width / 2, centre in the middle.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.images import decode_image, read_image_bytes
from ....data.recorded.poses import matrices, read_rows
from ....errors import BadFrameError, SequenceError
from ....types import Camera
from ..depth_files import DEPTH_SUFFIXES, metres
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, load_pair, with_colour
from .image_recording import size_of_colour
from .pairing import paired_by_name

_CAMERAS = ("left", "lcam_front", "right", "rcam_front")
"""Those that are looked for first."""
_NED_OF_CV = torch.tensor(
    [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
"""From OpenCV's axes to AirSim's."""

LOOKS_FOR = "image_left/, depth_left/ and pose_left.txt, or the same of another camera"


def recognise(path: Path) -> bool:
    """A trajectory of TartanAir."""
    return path.is_dir() and bool(_cameras(path))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A trajectory of TartanAir (module docstring); ``options.colour`` chooses another camera than
    the first.

    Raises:
        SequenceError: images and poses do not belong together.
    """
    cameras = _cameras(path)
    colour_name = Path(options.colour).name.removeprefix("image_")
    camera = colour_name if colour_name in cameras else cameras[0]
    colour = images_in(path / f"image_{camera}")
    depth = images_in(path / f"depth_{camera}", DEPTH_SUFFIXES)
    pairs = paired_by_name(path, colour, depth)
    file = path / f"pose_{camera}.txt"
    T_ned = matrices(read_rows(file, 7, "tx ty tz qx qy qz qw"))
    if len(T_ned) != len(colour):
        raise SequenceError(
            f"{file} holds {len(T_ned)} poses; expected {len(colour)}, one per image of "
            f"image_{camera}"
        )
    T_WC = dict(zip(colour, _NED_OF_CV.T @ T_ned @ _NED_OF_CV, strict=True))
    scale = options.depth_scale or 1.0

    def recorded_frames() -> Iterator[RecordedFrame]:
        for rgb, z in pairs:
            yield RecordedFrame(
                source=str(rgb),
                time_s=None,
                model=None if options.intrinsics else _model(rgb),
                T_WC=T_WC[rgb],
                load=partial(_load, rgb, z, scale),
            )

    others = f"; others, with --colour: {', '.join(cameras[1:])}" if len(cameras) > 1 else ""
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(pairs),
        depth_scale=scale,
        notes=(
            f"TartanAir's camera {camera}{others}; poses were turned from AirSim's axes (x "
            "forward, z down)",
        ),
    )


def _cameras(path: Path) -> list[str]:
    """Names of the cameras with images, depth and poses."""
    cameras = sorted(file.stem.removeprefix("pose_") for file in path.glob("pose_*.txt"))
    whole = [
        n for n in cameras if (path / f"image_{n}").is_dir() and (path / f"depth_{n}").is_dir()
    ]
    return sorted(
        whole, key=lambda name: _CAMERAS.index(name) if name in _CAMERAS else len(_CAMERAS)
    )


def _model(colour: Path) -> CameraModel:
    width, height = size_of_colour(colour)
    half = width / 2
    return CameraModel(
        Camera(
            width=width,
            height=height,
            fx=half,
            fy=half,
            cx=half,
            cy=height / 2,
        )
    )


def _load(colour: Path, depth: Path, scale: float) -> RgbdImages:
    if depth.suffix.lower() != ".png":
        return load_pair(colour, depth, scale)
    pixels = decode_image(read_image_bytes(depth, "depth"), cv2.IMREAD_UNCHANGED, depth, "depth")
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 4:
        raise BadFrameError(
            f"{depth} must hold float32 depth in four channels of 8 bits, got {list(pixels.shape)}"
        )
    depth_m = metres(pixels.view("<f4")[..., 0], scale)
    return with_colour(read_image_bytes(colour, "colour"), str(colour), depth_m)
