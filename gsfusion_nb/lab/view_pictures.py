"""The pictures of a run: held-out views as recorded and as rendered, and the error between them."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data import BadFrameError
from ..data.recorded.images import decode_rgb, read_image_bytes
from ..drawing.pictures import Picture, error_map
from .result import RunResult

_RENDER = re.compile(r"held_out (\S+)")


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewPictures:
    """One held-out view of a run."""

    name: str
    """Number of the frame, as in the names of the pictures."""
    truth: Picture
    """As recorded."""
    render: Picture
    """As rendered from the map."""

    @property
    def error(self) -> Picture:
        """Mean absolute error over the channels as colour (``drawing.pictures.error_map``)."""
        return error_map(self.render, self.truth)


def views_of(result: RunResult, folder: Path) -> Iterator[ViewPictures]:
    """The views of a run whose two pictures can be read, in the order of ``result.pictures``.

    Args:
        result: A run.
        folder: Where the file names of ``result.pictures`` are looked up.
    """
    for name, file in result.pictures.items():
        match = _RENDER.fullmatch(name)
        truth_file = result.pictures.get(f"truth {match[1]}") if match else None
        if match is None or truth_file is None:
            continue
        try:
            render, truth = _read(folder / file), _read(folder / truth_file)
        except BadFrameError:  # removed since, or damaged: the other views are still worth showing
            continue
        if render.shape == truth.shape:
            yield ViewPictures(name=match[1], truth=truth, render=render)


def _read(path: Path) -> Picture:
    return np.ascontiguousarray(decode_rgb(read_image_bytes(path, "colour"), path))
