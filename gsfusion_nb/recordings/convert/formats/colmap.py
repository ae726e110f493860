"""A COLMAP reconstruction with depth images of its own: ``sparse/0``, ``images/``, and a folder of
depth.

Poses are world-to-camera (inverted here), pixel centres at 0.5, lenses are undistorted. Structure
from motion has no unit of length: metres per unit are measured, as the median of (depth image) /
(depth of the sparse points), or given.
"""

import statistics
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ....data.recorded.files import natural_order
from ....errors import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import is_file
from ....geometry import se3
from ....types import Camera
from ..depth_files import find_depth, read_depth_file
from ..recording import ConvertOptions, RecordedFrame, Recording, load_pair
from .colmap_model import ColmapImage, read_model, read_points


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
