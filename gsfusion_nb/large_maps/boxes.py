"""The rows of a large map that a camera may see, found without a look at every Gaussian."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..edit_count import edit_count
from ..types import ALL_ROWS, Camera, GaussianParams, MapRows
from .chunks import (
    Chunks,
    chunks_of_gaussians,
    chunks_with_more_rows,
    renew_chunks_,
    rows_of_chunks,
    seen_chunks,
)

WHOLE_BELOW = 10_000
WHOLE_BELOW_ON_GPU = 1_000_000
"""A map with fewer rows is drawn, and stepped, as a whole, as it is published. A GPU has to wait
for the boxes: on an H200, steps by part took 17 ms a frame with up to 325,000 rows, where an H100
took 6 without parts."""

MOSTLY_SEEN = 0.7
"""A map of which more is seen is drawn as a whole: to copy so many rows would take longer than to
draw the others."""

View = TypeVar("View")


class Boxes:
    """Boxes around the chunks of a map, which are made anew when its tensors have changed
    (``edit_count``)."""

    def __init__(self) -> None:
        self._edits: tuple[int, ...] = ()
        """``_edits`` of the map when the boxes were made."""
        self._chunks = Chunks(
            np.zeros((0, 3)),
            np.zeros((0, 3)),
            np.zeros(0),
        )

    def rows(
        self,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        depth_m: Float[Tensor, "h w"] | None = None,
    ) -> MapRows:
        """Rows of the chunks that a camera may see, rising; all rows if there are few, or most are
        seen.

        Args:
            params: The map.
            camera, T_WC: as given to ``render``.
            depth_m: Measured depth of the view, of any size, 0 where missing; chunks behind it are
                left out. [h, w]
        """
        n = len(params)
        if n < (WHOLE_BELOW if params.xyz_W.device.type == "cpu" else WHOLE_BELOW_ON_GPU):
            return ALL_ROWS
        if self._edits != _edits(params):
            self._chunks = chunks_of_gaussians(params)
            self._edits = _edits(params)
        numbers = seen_chunks(self._chunks, camera, T_WC, depth_m)
        if len(numbers) > MOSTLY_SEEN * len(self._chunks.low):
            return ALL_ROWS
        return rows_of_chunks(numbers, n).to(params.xyz_W.device)

    def forget(self) -> None:
        """Make the boxes anew when they are asked for."""
        self._edits = ()

    @contextlib.contextmanager
    def appending(self, model: Any) -> Iterator[None]:
        """Context in which rows are only added at the end of a map: the boxes of the others
        stay."""
        n = len(model.params)
        is_current = self._edits == _edits(model.params)
        yield
        if is_current and self._edits != _edits(model.params):
            self._chunks = chunks_with_more_rows(self._chunks, model.params, n)
            self._edits = _edits(model.params)

    def renew(
        self,
        params: GaussianParams,
        rows: Int[Tensor, " R"],
        part: GaussianParams,
    ) -> None:
        """Follow a change of only these ``rows``, which were all in the last result; ``part``:
        their new values."""
        renew_chunks_(self._chunks, rows, part)
        self._edits = _edits(params)


def _edits(params: GaussianParams) -> tuple[int, ...]:
    """Another value when centres or sizes have changed."""
    return (len(params), *edit_count(params.xyz_W, params.log_scale))


def drawn_in_part(
    draw: Callable[[GaussianParams], View],
    params: GaussianParams,
    boxes: Boxes | None,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    depth_m: Float[Tensor, "h w"] | None = None,
    take: Callable[[MapRows], GaussianParams] | None = None,
) -> View:
    """The result of ``draw``, for which only the part of the map is drawn that the camera may see.

    Args:
        draw: From Gaussians to a dataclass of images; those whose names end with ``_index`` hold
            rows, -1: none.
        params: The map.
        boxes: Of the map; None draws all of it.
        camera, T_WC: as given to ``render``.
        depth_m: Measured depth, of any size: what is hidden behind it is left out, also where the
            map has a hole.
        take: Gives the values of rows; those in ``params`` by default.
    """
    rows = ALL_ROWS if boxes is None else boxes.rows(params, camera, T_WC, depth_m)
    view: Any = draw(params[rows] if take is None else take(rows))
    return view if isinstance(rows, slice) else _with_rows_of_map(view, rows)


def _with_rows_of_map(view: Any, rows: Int[Tensor, " R"]) -> Any:
    """The images of a part, whose indices count the rows of the map instead of those of the
    part."""
    indices = {
        name: x for name, x in vars(view).items() if name.endswith("_index") and x is not None
    }
    of_map = torch.cat([rows, rows.new_tensor([-1])])  # -1 is the last one
    return dataclasses.replace(
        view,
        **{name: of_map[x.long()].to(x.dtype) for name, x in indices.items()},
    )
