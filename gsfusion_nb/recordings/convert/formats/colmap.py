"""A COLMAP reconstruction with depth images of its own: ``sparse/0``, ``images/``, and a folder of depth.

Poses are world-to-camera (inverted here), pixel centres at 0.5, lenses are undistorted. Structure from motion has no
unit of length: metres per unit are measured, as the median of (depth image) / (depth of the sparse points), or given.
"""

import math
import os
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

from ....checks import shown
from ....data.lens import CameraModel
from ....data.recorded.files import natural_order
from ....data.recorded.times import PER_SECOND, time_unit
from ....data.sequence import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import is_file, open_regular, parsing, read_exactly, read_text
from ....geometry import quaternion, se3
from ..camera import model_of
from ..recording import ConvertOptions, RecordedFrame, Recording, find_depth, load_pair, read_depth_file

_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}  # fmt: skip
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_KNOWN = (*_ONE_FOCAL, "PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
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
    points_at: int
    """Place of its two-dimensional points in the file, bytes."""
    n_points: int
    """Their number; -1 in a text file, where all numbers of the line are points."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Cameras by id and images in order of the file."""

    folder: Path
    suffix: str
    cameras: dict[int, CameraModel]
    images: list[ColmapImage]

    def observations(self, image: ColmapImage) -> list[tuple[float, float, int]]:
        """Pixel x, y and id of every triangulated point that the image sees."""
        path = self.folder / f"images{self.suffix}"
        with open_regular(path, "COLMAP's images") as file, parsing(path, f"image points 'x y id' of {image.name}"):
            file.seek(image.points_at)
            if self.suffix == ".txt":
                words = file.readline(_LONGEST_LINE).split()
                rows = [(float(x), float(y), int(p)) for x, y, p in zip(*(words[i::3] for i in range(3)), strict=True)]
            else:
                rows = list(struct.iter_unpack("<ddq", read_exactly(file, 24 * image.n_points, path)))
        return [(x, y, p) for x, y, p in rows if p >= 0 and p != 2**64 - 1 and math.isfinite(x) and math.isfinite(y)]

    def points(self, wanted: set[int]) -> dict[int, tuple[float, float, float]]:
        """World positions of the requested points; empty where the model has no points3D file."""
        path = self.folder / f"points3D{self.suffix}"
        if not path.is_file():
            return {}
        found = {}
        if self.suffix == ".txt":
            with open_regular(path, "COLMAP's points") as text, parsing(path, "rows 'id x y z'"):
                while line := text.readline(_LONGEST_LINE):
                    words = line.split(maxsplit=4)
                    if len(words) > 3 and words[0] != b"#" and int(words[0]) in wanted:
                        found[int(words[0])] = (float(words[1]), float(words[2]), float(words[3]))
            return found
        with open_regular(path, "COLMAP's points") as file:
            for _ in range(_count(file, path)):
                point, x, y, z, *_, track = struct.unpack("<QdddBBBdQ", read_exactly(file, 51, path))
                _skip(file, 8 * track, path)
                if point in wanted:
                    found[point] = (x, y, z)
        return found


def read_model(folder: Path) -> ColmapModel:
    """A model of cameras.bin and images.bin, or of the text files of those names.

    Raises:
        SequenceError: a file is missing, cut short or damaged, or a camera has an unknown distortion.
    """
    suffix = next((s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file()), None)
    if suffix is None or not (folder / f"images{suffix}").is_file():
        raise SequenceError(f"{folder} holds no COLMAP model; expected cameras and images, both .bin or both .txt")
    read = (_cameras_txt, _images_txt) if suffix == ".txt" else (_cameras_bin, _images_bin)
    cameras, images = read[0](folder / f"cameras{suffix}"), read[1](folder / f"images{suffix}")
    for image in images:
        if image.camera not in cameras:
            raise SequenceError(
                f"{folder}/images{suffix}: {image.name} names camera {image.camera}, which does not exist"
            )
    if not images:
        raise SequenceError(f"{folder}/images{suffix} registers no image; expected at least one")
    return ColmapModel(folder, suffix, cameras, images)


def _cameras_txt(path: Path) -> dict[int, CameraModel]:
    cameras = {}
    for number, line in enumerate(read_text(path, "COLMAP's cameras").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            number_of, name, size = int(words[0]), words[1], (int(words[2]), int(words[3]))
            values = [float(w) for w in words[4:]]
        except (ValueError, IndexError):
            raise SequenceError(
                f"{path} line {number} must be 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]', got {shown(line)}"
            ) from None
        cameras[number_of] = _camera(name, size, values, f"{path} camera {number_of}")
    return cameras


def _cameras_bin(path: Path) -> dict[int, CameraModel]:
    cameras = {}
    with open_regular(path, "COLMAP's cameras") as file:
        for _ in range(_count(file, path)):
            number, model, width, height = struct.unpack("<iiQQ", read_exactly(file, 24, path))
            if model not in _MODELS:
                raise SequenceError(
                    f"{path} camera {number} has the unknown model {model}; expected one of COLMAP's; is this a "
                    "cameras.bin? otherwise run 'colmap image_undistorter' first"
                )
            name, n = _MODELS[model]
            values = list(struct.unpack(f"<{n}d", read_exactly(file, 8 * n, path)))
            cameras[number] = _camera(name, (width, height), values, f"{path} camera {number}")
    return cameras


def _camera(name: str, size: tuple[int, int], values: list[float], source: str) -> CameraModel:
    wanted = dict(_MODELS.values())
    if name not in _KNOWN:
        raise SequenceError(
            f"{source} has the model {name}, whose distortion gsfusion-nb cannot remove; known: {', '.join(_KNOWN)}; "
            "run "
            "'colmap image_undistorter' first and convert its result"
        )
    if len(values) != wanted[name]:
        raise SequenceError(f"{source} has {len(values)} parameters; {name} is expected to have {wanted[name]}")
    if name in _ONE_FOCAL:
        values = [values[0], *values]
    fisheye = "FISHEYE" in name
    k = values[4:]
    distortion = (*k, *(0.0,) * (4 - len(k))) if fisheye or k else ()
    return model_of(values[:4], size, source, centre=0.5, distortion=tuple(distortion), fisheye=fisheye)


def _images_txt(path: Path) -> list[ColmapImage]:
    images = []
    with open_regular(path, "COLMAP's images") as file:
        while line := file.readline(_LONGEST_LINE):
            words = line.decode(errors="replace").split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            try:
                pose, camera, name = [float(w) for w in words[1:8]], int(words[8]), words[9].strip()
            except (ValueError, IndexError):
                raise SequenceError(
                    f"{path}: expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME' and a line of points, got "
                    f"{shown(line.decode(errors='replace'))}"
                ) from None
            images.append(ColmapImage(name, camera, _pose(pose), file.tell(), -1))
            file.readline(_LONGEST_LINE)
    return images


def _images_bin(path: Path) -> list[ColmapImage]:
    images = []
    with open_regular(path, "COLMAP's images") as file:
        for _ in range(_count(file, path)):
            _, *pose, camera = struct.unpack("<I7dI", read_exactly(file, 64, path))
            name = bytearray()
            while (letter := read_exactly(file, 1, path)) != b"\0":
                name += letter
                if len(name) > _LONGEST_NAME:
                    raise SequenceError(f"{path} is damaged: the name of image {len(images)} does not end")
            (n_points,) = struct.unpack("<Q", read_exactly(file, 8, path))
            images.append(ColmapImage(name.decode(errors="replace"), camera, _pose(pose), file.tell(), n_points))
            _skip(file, 24 * n_points, path)
    return images


def _pose(values: list[float]) -> Float[Tensor, "4 4"]:
    T = torch.eye(4, dtype=torch.float64)
    quat = torch.tensor(values[:4], dtype=torch.float64)
    T[:3, :3] = quaternion.to_matrix(quat) if bool(quat.any()) else torch.nan
    T[:3, 3] = torch.tensor(values[4:], dtype=torch.float64)
    return T


def _count(file: BinaryIO, path: Path) -> int:
    return struct.unpack("<Q", read_exactly(file, 8, path))[0]


def _skip(file: BinaryIO, n: int, path: Path) -> None:
    if n > os.fstat(file.fileno()).st_size - file.tell():
        raise SequenceError(f"{path} is truncated: it ends before the {n} bytes that it claims; copy it again")
    file.seek(n, 1)


def metres_per_unit(
    model: ColmapModel, image: ColmapImage, depth_m: np.ndarray, points: dict[int, tuple[float, float, float]]
) -> list[float]:
    """Depth in metres over depth in the model's units, at every point that the image sees and that has depth."""
    height, width = depth_m.shape
    camera = model.cameras[image.camera].camera
    ratios = []
    for x, y, point in model.observations(image):
        u, v = int(x / camera.width * width), int(y / camera.height * height)
        if point in points and 0 <= u < width and 0 <= v < height and depth_m[v, u] > 0:
            xyz_W = torch.tensor([points[point]], dtype=torch.float64)
            z = float(se3.apply(image.T_CW, xyz_W)[0, 2])
            if z > 0:
                ratios.append(float(depth_m[v, u]) / z)
    return ratios


_MODEL_PLACES = ("", "sparse/0", "sparse", "0")
_DEPTH_PLACES = ("depth", "depths", "depth_maps")
_MEASURED_IMAGES = 20
_FEWEST_RATIOS = 30


def recognise(path: Path) -> bool:
    """A model in one of the usual places."""
    return _model_folder(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """Read a reconstruction and its depth images (module docstring)."""
    folder = _model_folder(path)
    if folder is None:
        raise SequenceNotFoundError(
            f"{path} holds no COLMAP model; expected cameras and images (.bin or .txt) in it or in sparse/0"
        )
    model = read_model(folder)
    images = sorted(model.images, key=lambda i: natural_order(Path(i.name)))
    colour = _beside(path, folder, ("images",), "colour images")
    depth = Path(options.depth) if options.depth else _beside(path, folder, _DEPTH_PLACES, "depth images (--depth)")
    if not depth.is_dir():
        raise SequenceNotFoundError(f"{depth} is not a folder; expected the depth images that belong to {colour}")
    scale = options.depth_scale or 1000.0

    def depth_file(image: ColmapImage) -> Path:
        name = depth / image.name
        found = find_depth(name.parent, name.stem)
        return found if is_file(found) else find_depth(name.parent, name.name)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for image in images:
            load = partial(load_pair, colour / image.name, depth_file(image), scale)
            yield RecordedFrame(
                source=str(colour / image.name),
                time_s=None if not options.poses else _time(colour / image.name),
                model=model.cameras[image.camera],
                T_WC=se3.inverse(image.T_CW),
                load=load,
            )

    def measured() -> tuple[float, str]:
        chosen = images[:: max(1, len(images) // _MEASURED_IMAGES)]
        return _measure(model, [(i, depth_file(i)) for i in chosen], scale)

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(images),
        depth_scale=scale,
        up_to_scale=True,
        measured_scale=measured,
        notes=(f"COLMAP model {folder}; depth {depth} read as {scale:g} per metre, registered to the colour images",),
    )


def _measure(model: ColmapModel, images: list[tuple[ColmapImage, Path]], scale: float) -> tuple[float, str]:
    """Metres per unit of the poses, and a sentence on how certain that is."""
    ids = {point for image, _ in images for _, _, point in model.observations(image)}
    points = model.points(ids)
    ratios: list[float] = []
    for image, file in images:
        try:
            ratios += metres_per_unit(model, image, read_depth_file(file, scale), points)
        except BadFrameError:
            continue
    if len(ratios) < _FEWEST_RATIOS:
        return 1.0, f"only {len(ratios)} sparse points have depth, too few to measure it"
    low, middle, high = statistics.quantiles(ratios, n=4)
    spread = (high - low) / middle
    return middle, f"measured on {len(ratios)} sparse points with depth, half of them within {100 * spread:.1f} %"


def _model_folder(path: Path) -> Path | None:
    names = ("cameras.bin", "cameras.txt")
    return next((path / p for p in _MODEL_PLACES if any((path / p / n).is_file() for n in names)), None)


def _beside(path: Path, model: Path, names: tuple[str, ...], what: str) -> Path:
    """Folder of one of ``names`` in the project, or in those above the model."""
    for root in (path, model.parent, model.parent.parent):
        for name in names:
            if (root / name).is_dir():
                return root / name
    raise SequenceNotFoundError(
        f"{path} has no folder {' or '.join(names)}/; expected the {what} of the reconstruction"
    )


def _time(image: Path) -> float | None:
    """Seconds of an image that is named by its time, such as 1305031102.175304 or 1403636579763555584; else None."""
    try:
        value = float(image.stem)
    except ValueError:
        return None
    return value / PER_SECOND[time_unit([value])] if math.isfinite(value) else None
