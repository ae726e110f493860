"""Some rows of a map, to be optimised while the others wait."""

from ..edit_count import edit_count
from ..gaussians import GaussianModel
from ..types import ALL_ROWS, MapRows
from .boxes import Boxes


class MapPart:
    """Rows of a map and their moments, for ``adam_step``; after ``write_back`` the map has their
    new values.

    Of ``ALL_ROWS``, or another slice, these are the map's own tensors or views of them, which a
    step changes in place; of numbers of rows they are copies. The rows that are left out keep their
    values and their moments until they take the steps that they missed
    (``gsfusion_nb.optim.take_missed_steps``).

    Args:
        model: The map.
        rows: Its rows that are optimised.
        boxes: Those of the map, from which the rows are; they follow. None: there are none.
    """

    def __init__(self, model: GaussianModel, rows: MapRows = ALL_ROWS, boxes: Boxes | None = None):
        self.model = model
        self.rows = rows
        self._boxes = boxes
        self.params = model.params[rows]
        self.moments = model.moments[rows]
        self.clock = model.clock.part(rows)
        self.rates = {name: factors[rows] for name, factors in model.rates.items()}
        self._edits = edits_of(model)

    @property
    def is_current(self) -> bool:
        """Whether the map has not changed since the rows were taken or written back."""
        return self._edits == edits_of(self.model)

    def write_back(self) -> None:
        """Copy parameters, moments and the number of steps to the map, unless they are the
        map's."""
        if isinstance(self.rows, slice):
            return
        for prefix, rows in (
            ("", self.params),
            ("exp_avg.", self.moments.exp_avg),
            ("exp_avg_sq.", self.moments.exp_avg_sq),
        ):
            for name, values in vars(rows).items():
                self.model.columns[prefix + name].index_copy_(0, self.rows, values)
        self.model.clock.write_back(self.rows, self.clock)
        if self._boxes is not None:
            self._boxes.renew(self.model.params, self.rows, self.params)
        self._edits = edits_of(self.model)


def edits_of(model: GaussianModel) -> tuple[int, ...]:
    """Another value when any value of the map has changed, or the number of rows or steps."""
    buffers = model.columns.buffers()
    return (len(model), model.clock.count, *edit_count(*buffers))
