"""A COLMAP reconstruction with depth images of its own: ``sparse/0``, ``images/``, and a folder of
depth.

Poses are world-to-camera (inverted here), pixel centres at 0.5, lenses are undistorted. Structure
from motion has no unit of length: metres per unit are measured, as the median of (depth image) /
(depth of the sparse points), or given.
"""

import statistics
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import natural_order
from ....errors import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import is_file, open_regular, parsing, read_exactly, read_text
from ....geometry import quaternion, se3
from ....types import Camera
from ..camera_numbers import model_of
from ..depth_files import find_depth, read_depth_file
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair

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


def metres_per_unit(
    camera: Camera,
    image: ColmapImage,
    depth_m: np.ndarray,
    points: dict[int, tuple[float, float, float]],
) -> list[float]:
    """Depth in metres over depth in the model's units, at every point that the image sees and that
    has depth."""
    height, width = depth_m.shape
    ratios = []
    for x, y, point in image.observations.tolist():
        if point not in points or not (0 <= x < camera.width and 0 <= y < camera.height):
            continue
        depth_at_point = float(
            depth_m[int(y / camera.height * height), int(x / camera.width * width)]
        )
        z = float(se3.apply(image.T_CW, torch.tensor([points[point]], dtype=torch.float64))[0, 2])
        if depth_at_point > 0 and z > 0:
            ratios.append(depth_at_point / z)
    return ratios


_MODEL_PLACES = ("", "sparse/*", "sparse", "[0-9]*")
_DEPTH_PLACES = ("depth", "depths", "depth_maps")
_MEASURED_IMAGES = 20
_FEWEST_RATIOS = 30
_LARGEST_SPREAD_PERCENT = 30.0
"""Interquartile range over median. Depth of a sensor has 1 to 5, also where a tenth of the points
are wrong."""
_INVERSE_DEPTH = "depth_params.json"
"""Beside the model where ``depths/`` holds inverse depth for 3D Gaussian splatting."""

LOOKS_FOR = "cameras and images, .bin or .txt, also in sparse/0, sparse/1 ..."


def recognise(path: Path) -> bool:
    """A model in one of the usual places."""
    return bool(_model_folders(path))


def read(path: Path, options: ConvertOptions) -> Recording:
    """Read a reconstruction and its depth images (module docstring)."""
    models = {folder: read_model(folder) for folder in _model_folders(path)}
    if not models:
        raise SequenceNotFoundError(
            f"{path} holds no COLMAP model; expected cameras and images (.bin or .txt) in it or in "
            "sparse/0"
        )
    folder, (cameras, images) = max(models.items(), key=lambda model: len(model[1][1]))
    others = ", ".join(
        f"{other} has {len(model[1])}" for other, model in models.items() if other != folder
    )
    images = sorted(images, key=lambda i: natural_order(Path(i.name)))
    colour = _beside(path, folder, ("images",), "colour images")
    own_depth = next(path.glob("**/depth_maps/*.bin"), None)
    if own_depth is not None and not options.depth:
        raise SequenceError(
            f"{own_depth} is a depth map of COLMAP's own, computed from the images and in the "
            "model's unit, not "
            "measured; RGB-D mapping needs measured depth: give its folder with --depth"
        )
    depth = (
        Path(options.depth)
        if options.depth
        else _beside(path, folder, _DEPTH_PLACES, "depth images (--depth)")
    )
    if not options.depth and (folder / _INVERSE_DEPTH).is_file():
        raise SequenceError(
            f"{folder / _INVERSE_DEPTH} says that {depth} holds inverse depth, as for the depth "
            "regularisation of 3D "
            "Gaussian splatting: no distances; give a folder of measured depth with --depth"
        )
    if not depth.is_dir():
        raise SequenceNotFoundError(
            f"{depth} is not a folder; expected the depth images that belong to {colour}"
        )
    scale = options.depth_scale or 1000.0

    def depth_file(image: ColmapImage) -> Path:
        name = depth / image.name
        depth_path = find_depth(name.parent, name.stem)
        return depth_path if is_file(depth_path) else find_depth(name.parent, name.name)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for image in images:
            load = partial(load_pair, colour / image.name, depth_file(image), scale)
            yield RecordedFrame(
                source=str(colour / image.name),
                time_s=None,
                model=cameras[image.camera],
                T_WC=se3.inverse(image.T_CW),
                load=load,
            )

    def measured() -> tuple[float, str]:
        sample = images[:: max(1, len(images) // _MEASURED_IMAGES)]
        points = read_points(folder)
        ratios = []
        for image in sample:
            try:
                depth_m = read_depth_file(depth_file(image), scale)
            except BadFrameError:
                continue
            ratios += metres_per_unit(cameras[image.camera].camera, image, depth_m, points)
        if len(ratios) < _FEWEST_RATIOS:
            return 1.0, f"only {len(ratios)} sparse points have depth, too few to measure it"
        low, middle, high = statistics.quantiles(ratios, n=4)
        spread_percent = 100 * (high - low) / middle
        if spread_percent > _LARGEST_SPREAD_PERCENT:
            raise SequenceError(
                f"{depth} does not hold the depth of this model: in metres per unit of the model, "
                f"half of the {len(ratios)} sparse points with depth lie within "
                f"{spread_percent:.0f} %, "
                f"and must within {_LARGEST_SPREAD_PERCENT:g} %; inverse depth must be inverted "
                "first; --scale and --depth-scale tell a unit"
            )
        return (
            middle,
            f"measured on {len(ratios)} sparse points with depth, half of them within "
            f"{spread_percent:.1f} %",
        )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(images),
        depth_scale=scale,
        up_to_scale=True,
        measured_scale=measured,
        notes=(
            f"COLMAP model {folder}; depth {depth} read as {scale:g} per metre, registered to the "
            "colour images",
            *(
                [
                    f"{folder} is the largest model, of {len(images)} images; {others}: give its "
                    "folder"
                ]
                if others
                else []
            ),
        ),
    )


def _model_folders(path: Path) -> list[Path]:
    """The models in the first of the usual places that has any: COLMAP writes one for each part
    that it can connect."""
    at = (sorted(path.glob(f"{place}/cameras.*".lstrip("/")), key=str) for place in _MODEL_PLACES)
    folders = ([file.parent for file in files if file.suffix in (".bin", ".txt")] for files in at)
    return list(dict.fromkeys(next(filter(None, folders), [])))


def _beside(
    path: Path,
    model: Path,
    names: tuple[str, ...],
    what: str,
) -> Path:
    """Folder of one of ``names`` in the project, or in those above the model."""
    for root in (path, model.parent, model.parent.parent):
        for name in names:
            if (root / name).is_dir():
                return root / name
    raise SequenceNotFoundError(
        f"{path} has no folder {' or '.join(names)}/; expected the {what} of the reconstruction"
    )
