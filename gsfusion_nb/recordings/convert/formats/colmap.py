"""A COLMAP reconstruction with depth images of its own: ``sparse/0``, ``images/``, and a folder of depth.

Poses are world-to-camera (inverted here), pixel centres at 0.5, lenses are undistorted. Structure from motion has no
unit of length: metres per unit are measured, as the median of (depth image) / (depth of the sparse points), or given.
"""

import statistics
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ....data.recorded.find_files import natural_order
from ....data.sequence import BadFrameError, SequenceError, SequenceNotFoundError
from ....foreign import is_file
from ....geometry import se3
from ..image_files import find_depth, load_pair, read_depth_file
from ..options import ConvertOptions
from ..recording import RecordedFrame, Recording
from .colmap_model import ColmapImage, ColmapModel, metres_per_unit, read_model

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
    from .tum_style import time_of_name

    try:
        return time_of_name(image)
    except SequenceError:
        return None
