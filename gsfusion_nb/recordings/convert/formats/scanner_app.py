"""3D Scanner App (iPhone, iPad), all data: ``frame_00000.jpg``, ``frame_00000.json``,
``depth_00000.png``, ``conf_*``.

The JSON of a frame holds ``intrinsics``, nine numbers for the colour image row by row,
``cameraPoseARFrame``, the camera-to-world matrix row by row with ARKit's axes (OpenGL: y up, z
backward), and ``time``. Depth is in millimetres, smaller than colour and registered to it. Only
some frames have a colour image.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import natural_order, number
from ....data.recorded.poses import GL_TO_CV
from ....errors import SequenceError
from ....files import is_file, parsing, read_object
from ..camera_numbers import model_of_matrix
from ..confidence import DepthConfidence
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair
from .image_recording import size_of_colour

LOOKS_FOR = "frame_00000.jpg, frame_00000.json and depth_00000.png"


def recognise(path: Path) -> bool:
    """A folder with frames of the app."""
    return path.is_dir() and bool(_colour_images(path))


def read(path: Path, options: ConvertOptions) -> Recording:
    """The frames that have a colour image (module docstring).

    Raises:
        SequenceError: none has one.
    """
    colour = _colour_images(path)
    if not colour:
        raise SequenceError(
            f"{path} holds no frame with a colour image, a JSON and depth; expected {LOOKS_FOR}"
        )
    scale = options.depth_scale or 1000.0
    n_depth = sum(1 for _ in path.glob("depth_*.png"))

    def recorded_frames() -> Iterator[RecordedFrame]:
        for image in colour:
            file = image.with_suffix(".json")
            values = read_object(file, "the camera of a frame")
            yield RecordedFrame(
                source=str(image),
                time_s=number(values, "time", 0.0, file) if "time" in values else None,
                model=None if options.intrinsics else _model(values, image, file),
                T_WC=_pose(values, file),
                load=partial(
                    load_pair,
                    image,
                    _of(image, "depth"),
                    scale,
                    _confidence(image, options.confidence),
                ),
            )

    n_unpaired = n_depth - len(colour)
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(colour),
        depth_scale=scale,
        dropped={"no colour image of its number": n_unpaired} if n_unpaired > 0 else {},
        notes=(
            f"3D Scanner App: depth read as {scale:g} per metre, of confidence "
            f"{options.confidence} and above",
        ),
    )


def _colour_images(path: Path) -> list[Path]:
    """Colour images of frames that also have a JSON and depth."""
    images = [file for file in path.glob("frame_*.jpg") if is_file(file.with_suffix(".json"))]
    return sorted((file for file in images if is_file(_of(file, "depth"))), key=natural_order)


def _of(image: Path, kind: str) -> Path:
    return image.with_name(f"{kind}{image.stem.removeprefix('frame')}.png")


def _confidence(image: Path, least: int) -> DepthConfidence | None:
    file = _of(image, "conf")
    return DepthConfidence(file, least) if least > 0 and is_file(file) else None


def _model(values: dict[str, Any], image: Path, file: Path) -> CameraModel:
    with parsing(file, "intrinsics, nine numbers row by row"):
        matrix = [float(value) for value in values["intrinsics"]]
    return model_of_matrix(matrix, size_of_colour(image), f"{file}: intrinsics", centre=0.5)


def _pose(values: dict[str, Any], file: Path) -> Float[Tensor, "4 4"]:
    with parsing(file, "cameraPoseARFrame, a matrix of 16 numbers row by row"):
        T = torch.tensor(values["cameraPoseARFrame"], dtype=torch.float64).reshape(4, 4)
    return T @ GL_TO_CV
