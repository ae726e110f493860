"""Lines of ``poses.txt``: 16 numbers, or the name of an image and 16 numbers."""

import itertools
import logging
import re
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..sequence import SequenceError
from .poses import read_words

log = logging.getLogger(__name__)

POSE_LINE = "16 row-major numbers of a camera-to-world pose, or the name of an image and these"
_SUFFIXES = (".jpg", ".jpeg", ".png")


def split_name(line: str) -> tuple[str | None, list[str]]:
    """Name of the image without its suffix, or ``None``, and the words after it."""
    words = line.replace(",", " ").split()
    if len(words) != 17:
        return None, words
    name = next((words[0][: -len(s)] for s in _SUFFIXES if words[0].lower().endswith(s)), words[0])
    return name, words[1:]


def parsed_pose(words: list[str]) -> Float[Tensor, "4 4"]:
    """A matrix of 16 words; float64, not yet checked. Raises ``ValueError`` if they are not 16 numbers."""
    values = [float(word) for word in words]
    if len(values) != 16:
        raise ValueError(f"expected 16 numbers, got {len(values)}")
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)


def image_key(name: str) -> str:
    """What names of one image have in common: "12" is "000012"."""
    return str(int(name)) if name.isdecimal() else name


def image_number(image: Path) -> int | None:
    """The whole number at the end of an image's name, or ``None``."""
    match = re.search(r"\d+$", image.stem)
    return None if match is None else int(match[0])


def poses_of_images(path: Path, images: list[Path], first_image: int | None) -> Float[Tensor, "N 4 4"]:
    """The pose of each image in a finished ``poses.txt``; float64, not yet checked. [N, 4, 4]

    Lines that begin with a name belong to the image of that name. Lines of numbers alone belong to the images in order,
    one each; with ``first_image`` to the images by the number at the end of their names, from that number on.

    Raises:
        SequenceError: a line that is not 16 numbers, an image without line, two lines of one name, or, where lines go
            by order, another number of lines than of images.
    """
    lines = [(number, split_name(" ".join(words))) for number, words in read_words(path, POSE_LINE)]
    names, rows = [], []
    for number, (name, words) in lines:
        try:
            rows.append(parsed_pose(words))
        except ValueError:
            got = f"{len(words)} words" if len(words) != 16 else "text"
            raise SequenceError(f"{path} line {number} must hold 16 numbers ({POSE_LINE}), got {got}") from None
        names.append(name)
    table = torch.stack(rows)
    if all(name is None for name in names):
        return table[_lines_by_number(path, len(rows), images, first_image)]
    return table[_lines_by_name(path, names, images)]


def _lines_by_name(path: Path, names: list[str | None], images: list[Path]) -> list[int]:
    line_of: dict[str, int] = {}
    for i, name in enumerate(names):
        if name is None:
            raise SequenceError(f"{path}: pose {i} has no name, but others have; expected a name on each line")
        if image_key(name) in line_of:
            raise SequenceError(f"{path} holds two poses of {name}; expected one per image")
        line_of[image_key(name)] = i
    lacking = [image for image in images if image_key(image.stem) not in line_of]
    if lacking:
        raise SequenceError(f"{path} has no pose of {lacking[0]}; expected one per image")
    return [line_of[image_key(image.stem)] for image in images]


def _lines_by_number(path: Path, n_lines: int, images: list[Path], first_image: int | None) -> list[int]:
    numbers = [image_number(image) for image in images]
    if first_image is not None:
        lines = [-1 if number is None else number - first_image for number in numbers]
        bad = [image for image, line in zip(images, lines, strict=True) if not 0 <= line < n_lines]
        if bad:
            raise SequenceError(
                f"{path} holds {n_lines} poses, from image {first_image} on; expected one for {bad[0]} among them"
            )
        return lines
    if n_lines != len(images):
        raise SequenceError(
            f"{path} holds {n_lines} poses; expected {len(images)}, one per image in {images[0].parent}; if images are "
            "missing, put first_image, the number of the first line's image, into intrinsics.json, or the name of its "
            "image before each pose"
        )
    steps = {b - a for a, b in itertools.pairwise(numbers) if a is not None and b is not None}
    if len(steps) > 1:
        gap = next(b for a, b in itertools.pairwise(images) if _step(a, b) != min(steps))
        log.warning(
            "%s: the numbers of the images have a gap before %s, but line k is taken as the pose of the k-th image: if "
            "an image is missing, all later poses are wrong (with first_image in intrinsics.json, lines belong to "
            "images by number)",
            path,
            gap.name,
        )
    return list(range(n_lines))


def _step(a: Path, b: Path) -> int:
    return (image_number(b) or 0) - (image_number(a) or 0)
