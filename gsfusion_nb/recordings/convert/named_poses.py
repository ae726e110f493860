"""Lists of poses that name images instead of times: "name,tx,ty,tz,qw,qx,qy,qz", with a header or
without."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...checks import shown
from ...data.recorded.poses import read_lines
from ...errors import SequenceError
from ...files import read_text
from .trajectory import check_order, columns_of_header, names_in

_NAMES = re.compile(
    r"(image|img|frame|rgb|colou?r|file)?_?(name|file|filename|path|filepath|id|index)s?"
    r"|image|img|frame|rgb|colou?r"
)
"""Of a column that says which image a pose belongs to."""

_WITHOUT_HEADER = {"xyzw": [4, 5, 6, 7], "wxyz": [5, 6, 7, 4]}


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """Poses of images by their names."""

    names: list[str]
    rows: Float[Tensor, "N 7"]
    """tx ty tz qx qy qz qw, float64."""
    order_is_assumed: bool
    """No header says the order of the quaternions."""


def read_named_poses(path: Path, quaternions: str) -> NamedPoses | None:
    """Poses of a file whose rows begin with the names of images, or None for other files.

    Without a header a row must be a name that is no number, and seven numbers. A header decides on
    the columns, and its first one may be the number of an image.

    Args:
        path: The file.
        quaternions: Their order where no header says it, "xyzw" or "wxyz"; "auto" is xyzw.

    Raises:
        SequenceError: a row without name and numbers, or a header of another order than
            ``quaternions``.
    """
    what = "lines 'name tx ty tz qx qy qz qw'"
    lines = [(number, _words(line)) for number, line in read_lines(path, what)]
    header = next((line for line in first_lines(path) if columns_of_header(line)), "")
    columns = columns_of_header(header)
    name_column = 0
    if columns is not None:
        check_order(columns, quaternions, path)
        names = names_in(header)
        name_column = next((i for i, name in enumerate(names) if _NAMES.fullmatch(name)), -1)
        lines = [(n, words) for n, words in lines if _words(header) != words]
        columns = columns[1:]
    else:
        columns = [1, 2, 3, *_WITHOUT_HEADER["wxyz" if quaternions == "wxyz" else "xyzw"]]
    if not header and not all(len(words) == 8 for _, words in lines):
        return None
    are_words = not any(is_number(words[0]) for _, words in lines)
    has_names = name_column == 0 and lines and (header or are_words)
    if not has_names or not (header or _is_pose(lines[0][1], columns)):
        return None
    rows = []
    for number, words in lines:
        if not _is_pose(words, columns):
            raise SequenceError(
                f"{path} line {number} must hold the name of an image, a position and a "
                f"quaternion, got {shown(' '.join(words))}"
            )
        rows.append([float(words[column]) for column in columns])
    return NamedPoses(
        [words[0] for _, words in lines],
        torch.tensor(rows, dtype=torch.float64),
        not header,
    )


def first_lines(path: Path) -> list[str]:
    """Comments and the first row: where a header may stand."""
    text = read_text(path, "a list of poses")
    lines = [line for line in text.splitlines() if line.strip()]
    n_comments = next(
        (i for i, line in enumerate(lines) if not line.lstrip().startswith("#")),
        len(lines),
    )
    return lines[: n_comments + 1]


def _words(line: str) -> list[str]:
    words = [word.strip("\"'") for word in re.split(r"\s*,\s*|\s+", line.strip())]
    return [word for word in words if word]


def _is_pose(words: list[str], columns: list[int]) -> bool:
    return max(columns) < len(words) and all(is_number(words[column]) for column in columns)


def is_number(word: str) -> bool:
    """Whether a word is a number, or stands for a lost one (nan)."""
    try:
        return not math.isnan(float(word)) or word.lower() == "nan"
    except ValueError:
        return False
