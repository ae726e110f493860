"""Camera intrinsics as an option or a frame gives them: numbers, matrices, JSON, YAML, and lines
that name values."""

import re
from pathlib import Path

from ...checks import shown
from ...data.lens import CameraModel
from ...errors import SequenceError
from ...files import read_text
from .calibration_tree import WAYS, tree_of_file
from .camera_in_tree import model_of_tree
from .camera_numbers import model_of, model_of_matrix
from .depth_files import read_array
from .recording import ConvertOptions, OptionNeeded, RecordedFrame
from .trajectory import read_numbers


def read_intrinsics(
    text_or_file: str, size: tuple[int, int], *, centre: float = 0.0
) -> CameraModel:
    """Camera of an option: numbers, or a file.

    Args:
        text_or_file: One of ``WAYS``.
        size: Width and height of the colour images, pixels; a file with a size of its own overrides
            it.
        centre: Where the intrinsics put the centre of the first pixel, 0 or 0.5; JSON may say
            ``pixel_centre``.

    Raises:
        SequenceError: none of these, a focal length that is not positive, several cameras of which
            none is said to be colour, or a part of the lens that is not known.
    """
    path = Path(text_or_file)
    try:
        values = [float(w) for w in text_or_file.replace(",", " ").split()]
        source = f"intrinsics {shown(text_or_file)}"
    except ValueError:
        tree = tree_of_file(path)
        if tree or path.suffix.lower() in (".json", ".yaml", ".yml"):
            return model_of_tree(tree, size, str(path), centre=centre)
        values = _numbers_of(path)
        source = str(path)
    if path.suffix == ".pincam" and len(values) == 6:
        size = (round(values[0]), round(values[1]))
        values = values[2:]
    if len(values) == 1:
        values = [values[0], values[0], size[0] / 2 - 0.5 + centre, size[1] / 2 - 0.5 + centre]
    if len(values) in (9, 16) and values[-1] == 1:
        return model_of_matrix(values, size, source, centre=centre)
    if len(values) not in (4, 8, 9, 12, 16, 18):
        raise SequenceError(f"{source} must be {WAYS}, got {len(values)} numbers")
    return model_of(
        values[:4],
        size,
        source,
        centre=centre,
        distortion=tuple(values[4:]),
    )


def intrinsics_of_frame(
    frame: RecordedFrame, size: tuple[int, int], name: str, options: ConvertOptions
) -> CameraModel:
    """Camera of a colour image: that of the options, or its own.

    Args:
        frame: The frame.
        size: Width and height of its colour image, pixels.
        name: Of the recording.
        options: How it is read.

    Raises:
        OptionNeeded: nothing tells it.
    """
    if options.intrinsics not in ("", "estimate"):
        return read_intrinsics(options.intrinsics, size, centre=options.pixel_centre)
    if frame.model is None:
        raise OptionNeeded(
            f"{name} does not contain the camera's intrinsics; give --intrinsics 'fx fy cx cy' "
            "(pixels), the focal length alone, or a file with them",
            option="intrinsics",
            question=f"What is the focal length of images of {size[0]}x{size[1]} in pixels? Or fx "
            "fy cx cy, or a file with them. estimate: it is measured on the images",
        )
    return frame.model


def _numbers_of(path: Path) -> list[float]:
    if path.suffix == ".npy":
        return read_array(path, WAYS).ravel().tolist()
    lines = [line.split("#")[0].strip() for line in read_text(path, WAYS).splitlines()]
    words = next((line for line in lines if re.search("[A-Za-z]{3}", line)), "")
    if words:
        raise SequenceError(
            f"{path} holds no camera in a way that is known, but {shown(words)}; known: {WAYS}"
        )
    return read_numbers(path, WAYS)
