"""A scene of the BOP benchmark (T-LESS, YCB-V, LM-O and others): ``rgb/``, ``depth/``,
``scene_camera.json``.

For each image the JSON holds the matrix ``cam_K``, ``depth_scale``, which makes millimetres of the
stored depth when multiplied (elsewhere the word means units per metre, or metres per unit), and
where known the pose ``cam_R_w2c``, ``cam_t_w2c``, world-to-camera in millimetres. OpenCV axes,
pixel centres at integers. ("BOP dataset format".)
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import images_in, number
from ....errors import SequenceError
from ....files import parsing, read_object
from ....geometry import se3
from ..camera_numbers import model_of_matrix
from ..depth_files import find_depth
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair
from .image_recording import size_of_colour

_FILE = "scene_camera.json"

LOOKS_FOR = f"rgb/, depth/ and {_FILE}"


def recognise(path: Path) -> bool:
    """A scene of BOP."""
    return (path / _FILE).is_file() and (path / "rgb").is_dir() and (path / "depth").is_dir()


def read(path: Path, options: ConvertOptions) -> Recording:
    """A scene of BOP (module docstring). A frame without pose is left out where others have one.

    Raises:
        SequenceError: an image that the JSON does not name, or an entry that is not as the format
            says.
    """
    file = path / _FILE
    cameras = read_object(file, "the cameras of BOP's images")
    colour = images_in(path / "rgb")
    entries = [_entry(cameras, image, file) for image in colour]
    scales = [
        options.depth_scale or 1000.0 / number(entry, "depth_scale", 1.0, file) for entry in entries
    ]
    has_poses = any("cam_R_w2c" in entry for entry in entries)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for image, entry, scale in zip(colour, entries, scales, strict=True):
            K = [float(value) for value in entry["cam_K"]]
            yield RecordedFrame(
                source=str(image),
                time_s=None,
                model=None
                if options.intrinsics
                else model_of_matrix(K, size_of_colour(image), f"{file}: cam_K", centre=0.0),
                T_WC=_pose(entry, f"{file}: the pose of {image.name}"),
                load=partial(load_pair, image, find_depth(path / "depth", image.stem), scale),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(colour),
        depth_scale=scales[0],
        has_poses=has_poses,
        notes=(
            f"BOP: depth read as {scales[0]:g} per metre, as depth_scale (millimetres per unit) "
            "says",
        ),
    )


def _entry(
    cameras: dict[str, Any],
    image: Path,
    file: Path,
) -> dict[str, Any]:
    key = str(int(image.stem)) if image.stem.isdecimal() else image.stem
    entry = cameras.get(key)
    if not isinstance(entry, dict) or "cam_K" not in entry:
        raise SequenceError(f"{file} has no cam_K of the image {key}; expected one of {image}")
    return entry


def _model(entry: dict[str, Any], image: Path, file: Path) -> CameraModel:
    with parsing(f"{file}: cam_K of {image.name}", "9 numbers"):
        matrix = [float(value) for value in entry["cam_K"]]
    return model_of_matrix(matrix, size_of_colour(image), f"{file}: cam_K", centre=0.0)


def _pose(
    entry: dict[str, Any],
    source: str,
) -> Float[Tensor, "4 4"] | None:
    if "cam_R_w2c" not in entry or "cam_t_w2c" not in entry:
        return None
    T_CW = torch.eye(4, dtype=torch.float64)
    with parsing(source, "cam_R_w2c of 9 numbers and cam_t_w2c of 3, millimetres"):
        T_CW[:3, :3] = torch.tensor(entry["cam_R_w2c"], dtype=torch.float64).reshape(3, 3)
        T_CW[:3, 3] = torch.tensor(entry["cam_t_w2c"], dtype=torch.float64).reshape(3) / 1000.0
    return se3.inverse(T_CW)
