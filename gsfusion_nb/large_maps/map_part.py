"""Some rows of a map, to be optimised while the others wait."""

from jaxtyping import Int
from torch import Tensor

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
        self.params, self.exp_avg, self.exp_avg_sq = (
            x[rows] for x in (model.params, model.exp_avg, model.exp_avg_sq)
        )
        self.clock = model.clock.part(rows)
        self.rates = {name: factors[rows] for name, factors in model.rates.items()}
        self._edits = model.edits

    @property
    def step_count(self) -> int:
        """Steps of the map, with those on the part."""
        return self.clock.count

    @property
    def birth_step(self) -> Int[Tensor, " R"]:
        """Value of ``step_count`` when each row was added, or its moments were forgotten."""
        return self.clock.birth

    @property
    def is_current(self) -> bool:
        """Whether the map has not changed since the rows were taken or written back."""
        return self._edits == self.model.edits

    def write_back(self) -> None:
        """Copy parameters, moments and the number of steps to the map, unless they are the
        map's."""
        if isinstance(self.rows, slice):
            return
        for name in ("params", "exp_avg", "exp_avg_sq"):
            for column, values in vars(getattr(self, name)).items():
                getattr(getattr(self.model, name), column).index_copy_(0, self.rows, values)
        self.model.clock.write_back(self.rows, self.clock)
        if self._boxes is not None:
            self._boxes.renew(self.model.params, self.rows, self.params)
        self._edits = self.model.edits
