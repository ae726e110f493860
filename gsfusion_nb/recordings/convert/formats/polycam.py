"""Polycam's raw data: ``keyframes/`` with ``images/``, ``depth/``, ``confidence/`` and
``cameras/``, one JSON an image.

The JSON holds fx, fy, cx, cy and the size of the image, and the rows ``t_00`` to ``t_23`` of the
camera-to-world matrix with ARKit's axes (OpenGL: y up, z backward). Depth is in millimetres,
smaller than colour and registered to it; pixels from the corner of the image.
``corrected_cameras/`` and ``corrected_images/`` are those after Polycam closed the loops and
removed the lens, and are preferred. (nerfstudio's ``polycam_utils``, which also turns the world.)
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.recorded.files import images_in, number
from ....data.recorded.poses import GL_TO_CV
from ....errors import SequenceError
from ....files import parsing, read_object
from ..camera_in_tree import model_of_tree
from ..confidence import confidence_of
from ..depth_files import find_depth
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair

LOOKS_FOR = "keyframes/ with images/, depth/ and cameras/"


def recognise(path: Path) -> bool:
    """Raw data of Polycam, or its keyframes/."""
    folder = _keyframes(path)
    return all((folder / name).is_dir() for name in ("images", "depth", "cameras"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """Raw data of Polycam (module docstring)."""
    folder = _keyframes(path)
    has_corrected = all((folder / f"corrected_{name}").is_dir() for name in ("images", "cameras"))
    prefix = "corrected_" if has_corrected else ""
    colour = images_in(folder / f"{prefix}images")
    scale = options.depth_scale or 1000.0

    def recorded_frames() -> Iterator[RecordedFrame]:
        for image in colour:
            file = folder / f"{prefix}cameras/{image.stem}.json"
            values = read_object(file, "Polycam's camera of an image")
            depth = find_depth(folder / "depth", image.stem)
            sure = confidence_of(depth, options.confidence)
            yield RecordedFrame(
                source=str(image),
                time_s=None,
                model=None
                if options.intrinsics
                else model_of_tree(values, None, str(file), centre=0.5),
                T_WC=_pose(values, file),
                load=partial(load_pair, image, depth, scale, sure),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(colour),
        depth_scale=scale,
        notes=(
            f"Polycam: {'corrected' if has_corrected else 'uncorrected'} images and cameras; depth "
            f"read as {scale:g} per metre, of confidence {options.confidence} and above",
        ),
    )


def _keyframes(path: Path) -> Path:
    return path / "keyframes" if (path / "keyframes").is_dir() else path


def _pose(values: dict[str, Any], file: Path) -> Float[Tensor, "4 4"]:
    T = torch.eye(4, dtype=torch.float64)
    names = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    if missing := [name for name in names if name not in values]:
        raise SequenceError(
            f"{file} lacks {', '.join(missing)}; expected t_00 to t_23, three rows of the "
            "camera-to-world matrix"
        )
    with parsing(file, "t_00 to t_23, three rows of a camera-to-world matrix"):
        for row in range(3):
            for column in range(4):
                T[row, column] = number(values, f"t_{row}{column}", 0.0, file)
    return T @ GL_TO_CV
