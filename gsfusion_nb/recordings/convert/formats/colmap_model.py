"""The files of a COLMAP model: cameras, images and points, as text or binary."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....errors import SequenceError
from ....files import open_regular, parsing, read_exactly, read_text
from ....geometry import quaternion
from ..camera_numbers import model_of

_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}

_ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
)

_KNOWN = (*_ONE_FOCAL, "PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FISHEYE", "FULL_OPENCV")

_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])

_LONGEST_LINE = 100_000_000
"""Bytes; the points of one image are one line."""

_LONGEST_NAME = 4096


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One registered image."""

    name: str
    """Path below the image folder."""
    camera: int
    T_CW: Float[Tensor, "4 4"]
    observations: np.ndarray
    """Pixel x, y and number of every triangulated point that it sees. [K] of ``_OBSERVATION``"""


def read_model(folder: Path) -> tuple[dict[int, CameraModel], list[ColmapImage]]:
    """Cameras by id and images in order of the file, from cameras.bin and images.bin or the text
    files of those names.

    Raises:
        SequenceError: a file is missing, cut short or damaged, or a camera has an unknown
            distortion.
    """
    suffix = next(
        (s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file()),
        None,
    )
    if suffix is None or not (folder / f"images{suffix}").is_file():
        raise SequenceError(
            f"{folder} holds no COLMAP model; expected cameras and images, both .bin or both .txt"
        )
    read = (_cameras_txt, _images_txt) if suffix == ".txt" else (_cameras_bin, _images_bin)
    cameras = read[0](folder / f"cameras{suffix}")
    path = folder / f"images{suffix}"
    with (
        open_regular(path, "COLMAP's images") as file,
        parsing(path, "COLMAP's images and lines of points"),
    ):
        images = list(read[1](file, path))
    if not images or any(image.camera not in cameras for image in images):
        raise SequenceError(
            f"{path} must register images of the cameras {', '.join(map(str, cameras))}"
        )
    return cameras, images


def read_points(folder: Path) -> dict[int, tuple[float, float, float]]:
    """World positions of the sparse points by number; empty where the model has no points3D
    file."""
    path = next(
        (p for p in (folder / "points3D.bin", folder / "points3D.txt") if p.is_file()), None
    )
    point_of = {}
    if path is None:
        return point_of
    with open_regular(path, "COLMAP's points") as file, parsing(path, "rows 'id x y z'"):
        if path.suffix == ".txt":
            while line := file.readline(_LONGEST_LINE):
                words = line.split(maxsplit=4)
                if len(words) > 3 and words[0] != b"#":
                    point_of[int(words[0])] = (float(words[1]), float(words[2]), float(words[3]))
            return point_of
        for _ in range(_count(file, path)):
            point, x, y, z, *_, track = struct.unpack("<QdddBBBdQ", read_exactly(file, 51, path))
            read_exactly(file, 8 * track, path)
            point_of[point] = (x, y, z)
    return point_of


def _cameras_txt(path: Path) -> dict[int, CameraModel]:
    cameras = {}
    for number, line in enumerate(read_text(path, "COLMAP's cameras").splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            with parsing(f"{path} line {number}", "'CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]'"):
                size = (int(words[2]), int(words[3]))
                values = [float(w) for w in words[4:]]
                cameras[int(words[0])] = _camera(
                    words[1], size, values, f"{path} camera {words[0]}"
                )
    return cameras


def _cameras_bin(path: Path) -> dict[int, CameraModel]:
    cameras = {}
    with open_regular(path, "COLMAP's cameras") as file:
        for _ in range(_count(file, path)):
            number, model, width, height = struct.unpack("<iiQQ", read_exactly(file, 24, path))
            if model not in _MODELS:
                raise SequenceError(
                    f"{path} camera {number} has the unknown model {model}; expected one of "
                    "COLMAP's"
                )
            name, n = _MODELS[model]
            values = list(struct.unpack(f"<{n}d", read_exactly(file, 8 * n, path)))
            cameras[number] = _camera(name, (width, height), values, f"{path} camera {number}")
    return cameras


def _camera(
    name: str,
    size: tuple[int, int],
    values: list[float],
    source: str,
) -> CameraModel:
    counts = dict(_MODELS.values())
    if name not in _KNOWN:
        raise SequenceError(
            f"{source} has the model {name}, whose distortion gsfusion-nb cannot remove; known: "
            f"{', '.join(_KNOWN)}; run 'colmap image_undistorter' first and convert its result"
        )
    if len(values) != counts[name]:
        raise SequenceError(
            f"{source} has {len(values)} parameters; {name} is expected to have {counts[name]}"
        )
    if name in _ONE_FOCAL:
        values = [values[0], *values]
    fisheye = "FISHEYE" in name
    k = values[4:]
    distortion = (*k, *(0.0,) * (4 - len(k))) if fisheye or k else ()
    return model_of(
        values[:4], size, source, centre=0.5, distortion=tuple(distortion), fisheye=fisheye
    )


def _images_txt(file: BinaryIO, path: Path) -> Iterator[ColmapImage]:
    while line := file.readline(_LONGEST_LINE):
        words = line.decode(errors="replace").split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        points = file.readline(_LONGEST_LINE).split()
        rows = [
            (float(x), float(y), int(p))
            for x, y, p in zip(*(points[i::3] for i in range(3)), strict=True)
        ]
        pose = [float(w) for w in words[1:8]]
        yield ColmapImage(
            words[9].strip(),
            int(words[8]),
            _pose(pose),
            _triangulated(np.array(rows, _OBSERVATION)),
        )


def _images_bin(file: BinaryIO, path: Path) -> Iterator[ColmapImage]:
    for _ in range(_count(file, path)):
        _, *pose, camera = struct.unpack("<I7dI", read_exactly(file, 64, path))
        name = bytearray()
        while (letter := read_exactly(file, 1, path)) != b"\0":
            name += letter
            if len(name) > _LONGEST_NAME:
                raise SequenceError(f"{path} is damaged: a name does not end")
        rows = np.frombuffer(
            read_exactly(file, _OBSERVATION.itemsize * _count(file, path), path), _OBSERVATION
        )
        yield ColmapImage(name.decode(errors="replace"), camera, _pose(pose), _triangulated(rows))


def _triangulated(rows: np.ndarray) -> np.ndarray:
    return rows[rows["point"] >= 0]


def _pose(values: list[float]) -> Float[Tensor, "4 4"]:
    T = torch.eye(4, dtype=torch.float64)
    quat = torch.tensor(values[:4], dtype=torch.float64)
    T[:3, :3] = quaternion.to_matrix(quat) if bool(quat.any()) else torch.nan
    T[:3, 3] = torch.tensor(values[4:], dtype=torch.float64)
    return T


def _count(file: BinaryIO, path: Path) -> int:
    return struct.unpack("<Q", read_exactly(file, 8, path))[0]
