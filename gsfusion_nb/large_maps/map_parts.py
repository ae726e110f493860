"""The parts of a map that gradient steps change one after the other, and the steps that the other
rows miss."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..gaussians import GaussianModel
from ..types import ALL_ROWS, GaussianParams, MapRows, Seeds
from .boxes import Boxes
from .map_part import MapPart

CatchUp = Callable[[MapPart], None]
"""Takes, in place, the steps of the optimiser that rows missed (``take_missed_steps`` of Adam)."""

_ROWS_AT_A_TIME = 1 << 16
"""Of a map whose missed steps are taken in a copy, which limits the memory."""


class MapParts:
    """Which rows of a map a gradient step changes: those that its view may show, or a small map as
    a whole.

    A row that is left out of a step misses it. It takes the steps that it missed, all at once, when
    a view shows it again, or when somebody reads the map.

    Args:
        model: The map.
        catch_up: Takes missed steps; None: the optimiser has none that can be taken later.
        depth_of: Measured depth of a view, of any size, or None; rows behind it are left out.
    """

    def __init__(
        self,
        model: GaussianModel,
        catch_up: CatchUp | None,
        depth_of: Callable[[Any], Tensor | None],
    ):
        self.boxes = Boxes()
        """Of the rows of the map, to find those that a view may show."""
        self._model = model
        self._catch_up = catch_up
        self._depth_of = depth_of
        self._steps_missed = bool(model.clock.steps_missed.any())
        """Whether rows may have missed steps."""
        self._last_views: Sequence[Any] = ()
        self._last_part: MapPart | None = None
        """Views of the last step, and the rows that it changed."""

    def append(self, seeds: Seeds, frame_index: int) -> None:
        """Add rows to the map (``GaussianModel.append``); the boxes around the others stay."""
        with self.boxes.appending(self._model):
            self._model.append(seeds, frame_index)

    def in_view(self, view: Any, later: Sequence[Any] = ()) -> MapPart:
        """The rows that a gradient step on this view changes.

        The steps of a frame on one view take the same rows, as long as nothing else changes the
        map. So do the steps on ``later`` views, whose rows are taken together with these.

        Args:
            view: A frame or keyframe, with ``camera`` and ``T_WC``.
            later: Further views.
        """
        views = (view, *later)
        part = self._last_part
        if part is not None and part.is_current and self._are_last_views(views):
            self._model.undo_log.will_change(part.rows)
            return part
        part = MapPart(self._model, self._rows_of(views), self.boxes)
        self._model.undo_log.will_change(part.rows)
        self._steps_missed |= isinstance(part.rows, Tensor)
        # else a GPU would be waited for in small maps
        if self._catch_up is not None and self._steps_missed:
            self._catch_up(part)
        self._last_views = views
        self._last_part = part
        return part

    def forget(self) -> None:
        """The next step looks for its rows anew."""
        self._last_views = ()
        self._last_part = None

    def end_frame(self) -> None:
        """Forget what was found in a frame. Between frames others may write to the map, also past
        what ``edit_count`` counts; and a run that is resumed there begins with nothing."""
        self.forget()
        self.boxes.forget()

    def params_now(self, rows: MapRows = ALL_ROWS) -> GaussianParams:
        """The rows with the steps that they missed while no view showed them; the map does not
        change. What is written, scored, drawn or given to a rule is made from these.

        Returns:
            A copy, or the map's own tensors if all are asked for and none misses a step.
        """
        if self._catch_up is None or not self._steps_missed:
            return self._model.params[rows]
        return params_now(self._model, self._catch_up, rows)

    def take_missed_steps(self) -> None:
        """Bring all rows of the map up to date, in place.

        That changes when a row is rounded, so it is done where the run says, not where somebody
        looks at the map.
        """
        if self._catch_up is None or not self._steps_missed:
            return
        self._model.undo_log.will_change()
        self._catch_up(MapPart(self._model))
        self._steps_missed = False

    def rows_changed(self, old_rows: Int[Tensor, " N"]) -> None:
        """Called after rows were removed or a rule edited the map; parts that hold copies of rows
        bring them up to date.

        Args:
            old_rows: For each row of the map its number before, -1 for new rows. [N]
        """

    def snapshot(self) -> Callable[[], None]:
        """A function that undoes what steps from now on change here, besides the map."""
        steps_missed = self._steps_missed

        def undo() -> None:
            self._steps_missed = steps_missed
            self.forget()

        return undo

    def _are_last_views(self, views: Sequence[Any]) -> bool:
        return {id(view) for view in views} <= {id(view) for view in self._last_views}

    def _rows_of(self, views: Sequence[Any]) -> MapRows:
        """Rows that any of the views may show."""
        params = self._model.params
        seen = []
        for view in views:
            rows = self.boxes.rows(params, view.camera, view.T_WC, self._depth_of(view))
            if isinstance(rows, slice):
                return ALL_ROWS
            seen.append(rows)
        return seen[0] if len(seen) == 1 else torch.cat(seen).unique()


def params_now(model: GaussianModel, catch_up: CatchUp, rows: MapRows = ALL_ROWS) -> GaussianParams:
    """Parameters of a map as they are with the steps that rows missed; the map does not change.

    Args:
        model: The map.
        catch_up: Takes missed steps.
        rows: Rows of the map.

    Returns:
        A copy, or the map's own tensors if all rows are asked for and none misses a step.
    """
    params = model.params[rows]
    late = model.clock.steps_missed[rows].nonzero()[:, 0]
    if not len(late):
        return params
    if isinstance(rows, slice):
        params = GaussianParams(**{name: column.clone() for name, column in vars(params).items()})
    numbers = torch.arange(len(model), device=model.device)[rows]
    for places in late.split(_ROWS_AT_A_TIME):
        part = MapPart(model, numbers[places])
        catch_up(part)
        for name, values in vars(part.params).items():
            getattr(params, name)[places] = values
    return params
