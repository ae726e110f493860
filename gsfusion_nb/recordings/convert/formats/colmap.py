"""A COLMAP reconstruction with depth images of its own: ``sparse/0``, ``images/``, and a folder of
depth.

Poses are world-to-camera (inverted here), pixel centres at 0.5, lenses are undistorted. Structure
from motion has no unit of length: metres per unit are measured, as the median of (depth image) /
(depth of the sparse points), or given.
"""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ....data.lens import CameraModel
from ....data.recorded.files import natural_order, told_outside
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
    colour = _beside(path, folder, ("images",), "colour images")
    reconstruction = _Reconstruction(
        folder=folder,
        cameras=cameras,
        images=sorted(images, key=lambda i: natural_order(Path(i.name))),
        colour=colour,
        depth=_depth_folder(path, folder, colour, options),
        depth_scale=options.depth_scale or 1000.0,
    )
    notes = [
        f"COLMAP model {folder}; depth {reconstruction.depth} read as "
        f"{reconstruction.depth_scale:g} per metre, registered to the colour images"
    ]
    if others:
        notes.append(
            f"{folder} is the largest model, of {len(images)} images; {others}: give its folder"
        )
    if outside_note := told_outside(colour, (colour / image.name for image in images)):
        notes.append(outside_note)
    return Recording(
        name=str(path),
        frames=reconstruction.frames,
        n_frames=len(images),
        depth_scale=reconstruction.depth_scale,
        up_to_scale=True,
        measured_scale=reconstruction.measured_scale,
        notes=tuple(notes),
    )


def _depth_folder(path: Path, folder: Path, colour: Path, options: ConvertOptions) -> Path:
    """Where the measured depth of the model in ``folder`` is.

    Raises:
        SequenceError: there is only depth that is in no unit of length.
        SequenceNotFoundError: there is none.
    """
    own_depth = next(path.glob("**/depth_maps/*.bin"), None)
    if own_depth is not None and not options.depth:
        raise SequenceError(
            f"{own_depth} is a depth map of COLMAP's own, computed from the images and in the "
            "model's unit, not measured; RGB-D mapping needs measured depth: give its folder with "
            "--depth"
        )
    depth = (
        Path(options.depth)
        if options.depth
        else _beside(path, folder, _DEPTH_PLACES, "depth images (--depth)")
    )
    if not options.depth and (folder / _INVERSE_DEPTH).is_file():
        raise SequenceError(
            f"{folder / _INVERSE_DEPTH} says that {depth} holds inverse depth, as for the depth "
            "regularisation of 3D Gaussian splatting: no distances; give a folder of measured "
            "depth with --depth"
        )
    if not depth.is_dir():
        raise SequenceNotFoundError(
            f"{depth} is not a folder; expected the depth images that belong to {colour}"
        )
    return depth


@dataclass(frozen=True, kw_only=True)
class _Reconstruction:
    """A model, and the folders of its colour and depth images."""

    folder: Path
    """Of the model."""
    cameras: dict[int, CameraModel]
    images: list[ColmapImage]
    colour: Path
    depth: Path
    depth_scale: float
    """Stored depth of one metre."""

    def frames(self) -> Iterator[RecordedFrame]:
        """The images in order, with their poses in the unit of the model."""
        for image in self.images:
            colour_file = self.colour / image.name
            yield RecordedFrame(
                source=str(colour_file),
                time_s=None,
                model=self.cameras[image.camera],
                T_WC=se3.inverse(image.T_CW),
                load=partial(load_pair, colour_file, self._depth_file(image), self.depth_scale),
            )

    def measured_scale(self) -> tuple[float, str]:
        """Metres in a unit of the model, and how that was measured.

        Raises:
            SequenceError: the depth images are not those of this model.
        """
        ratios = self._metres_per_unit()
        if len(ratios) < _FEWEST_RATIOS:
            return 1.0, f"only {len(ratios)} sparse points have depth, too few to measure it"
        low, middle, high = statistics.quantiles(ratios, n=4)
        spread_percent = 100 * (high - low) / middle
        if spread_percent > _LARGEST_SPREAD_PERCENT:
            raise SequenceError(
                f"{self.depth} does not hold the depth of this model: in metres per unit of the "
                f"model, half of the {len(ratios)} sparse points with depth lie within "
                f"{spread_percent:.0f} %, and must within {_LARGEST_SPREAD_PERCENT:g} %; inverse "
                "depth must be inverted first; --scale and --depth-scale tell a unit"
            )
        return (
            middle,
            f"measured on {len(ratios)} sparse points with depth, half of them within "
            f"{spread_percent:.1f} %",
        )

    def _metres_per_unit(self) -> list[float]:
        """Of the points that a sample of the images sees."""
        points = read_points(self.folder)
        ratios = []
        for image in self.images[:: max(1, len(self.images) // _MEASURED_IMAGES)]:
            try:
                depth_m = read_depth_file(self._depth_file(image), self.depth_scale)
            except BadFrameError:
                continue
            ratios += metres_per_unit(self.cameras[image.camera].camera, image, depth_m, points)
        return ratios

    def _depth_file(self, image: ColmapImage) -> Path:
        name = self.depth / image.name
        depth_path = find_depth(name.parent, name.stem)
        return depth_path if is_file(depth_path) else find_depth(name.parent, name.name)


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
