"""Further images of a recording's frames, such as label maps, read from files that are named by a
pattern."""

import io
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ...errors import ArgumentError, BadFrameError, SequenceNotFoundError
from ...types import Frame
from ..recorded.images import decode_image, read_image_bytes

_PLACES = ("index", "stem")
_WIDER = {np.dtype(np.uint16): np.int32, np.dtype(np.uint32): np.int64}
"""Types that torch cannot index, and those that hold the same numbers."""


@dataclass(frozen=True, kw_only=True)
class ExtraFiles:
    """A function from a frame to its further images, read from files (``open_sequence``).

    Args:
        folder: Folder of the recording.
        patterns: Name of an image -> its file, from that folder, with ``{index}`` for the number of
            the frame or ``{stem}`` for the name of its colour image without the ending:
            "labels/{index:06d}.png". A PNG with a palette gives the numbers of its entries; an
            ending .npy is an array [H, W, ...].
        stems: Names of the colour images of all frames, without endings.

    Raises:
        ValueError: another place than these two in a pattern.
        SequenceNotFoundError: the file of the first frame is missing.
    """

    folder: Path
    patterns: Mapping[str, str]
    stems: Sequence[str]

    def __post_init__(self):
        for name, pattern in self.patterns.items():
            if not isinstance(pattern, str):
                raise ArgumentError(f"extra {name!r} must be a pattern of files, got {pattern!r}")
            if not _is_pattern(pattern):
                raise ArgumentError(
                    f"extra {name!r} must name a file of each frame, with {{index}} or {{stem}}, "
                    f"got {pattern!r}"
                )
            if not self.file(name, 0).is_file():
                raise SequenceNotFoundError(
                    f"{self.file(name, 0)} does not exist; expected the image {name!r} of the "
                    "first frame"
                )

    def file(self, name: str, index: int) -> Path:
        """The file of an image of a frame."""
        return self.folder / self.patterns[name].format(index=index, stem=self.stems[index])

    def files(self, indices: Sequence[int]) -> list[Path]:
        """The files of all images of some frames."""
        return [self.file(name, index) for index in indices for name in self.patterns]

    def __call__(self, frame: Frame) -> dict[str, np.ndarray]:
        return {name: read_extra(self.file(name, frame.index)) for name in self.patterns}


@dataclass(frozen=True, kw_only=True)
class ExtraSample:
    """The further images of one frame for any other, of whatever size: for a check of a rule on
    scenes that have none."""

    images: Mapping[str, np.ndarray]

    def __call__(self, frame: Frame) -> dict[str, np.ndarray]:
        height, width = frame.depth_m.shape
        return {
            name: image[np.arange(height) * len(image) // height][
                :, np.arange(width) * image.shape[1] // width
            ]
            for name, image in self.images.items()
        }


def read_extra(file: Path) -> np.ndarray:
    """The image in a file: labels as they are stored, colours in the order red, green, blue.
    [H, W, ...]

    Raises:
        BadFrameError: it is missing, damaged, or not an image.
    """
    data = read_image_bytes(file, "further")
    if file.suffix == ".npy":
        try:  # mapped, so that a header cannot ask for more memory than the file has
            image = np.array(np.load(file, mmap_mode="r", allow_pickle=False))
        except (ValueError, EOFError, OSError) as e:
            raise BadFrameError(f"{file} is not an array of NumPy: {e}") from None
    else:
        image = decode_image(data, cv2.IMREAD_UNCHANGED, file, "further")
        if _has_palette(data):
            image = np.asarray(Image.open(io.BytesIO(data)))
        elif image.ndim == 3:
            image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    return np.ascontiguousarray(image.astype(_WIDER.get(image.dtype, image.dtype)))


def _is_pattern(text: str) -> bool:
    """Whether a text names another file for each frame."""
    try:
        places = {place for _, place, *_ in string.Formatter().parse(text) if place is not None}
        text.format(index=0, stem="")
    except (ValueError, IndexError, KeyError):
        return False
    return bool(places) and places <= set(_PLACES)


def _has_palette(data: bytes) -> bool:
    """Whether this is a PNG whose pixels are numbers of colours."""
    return data.startswith(b"\x89PNG") and data[25:26] == b"\x03"
