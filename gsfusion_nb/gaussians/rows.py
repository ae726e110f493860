"""Columns of one length that grow together: a row is added, copied, removed and saved in all of
them."""

from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..checks import check_shape
from ..resources import MAP_MEMORY
from ..types import ALL_ROWS, MapRows

_FIRST_CAPACITY = 4096
_GROWTH = {"cpu": 2.0, "cuda": 1.25}
"""Rows that are full grow by this factor. Untouched memory is free on a CPU; on a GPU it is taken
from the rest."""


class UndoLog:
    """Rows as they were before they were changed.

    Args:
        count: Number of rows when it began.
        names: Of the columns then.
    """

    def __init__(self, count: int, names: set[str]):
        self.count = count
        self.names = names
        self.entries: list[dict[str, Tensor] | tuple[Tensor, dict[str, Tensor]]] = []
        """Rows and their values, or a whole ``snapshot``, in the order of the changes."""
        self.has_row: Tensor | None = None
        """Which rows are in it."""
        self.has_all = False


class GrowingRows:
    """Rows in buffers that grow by a factor when full; what is given out are views of the rows in
    use.

    A subclass defines ``device`` and ``_new_column``. Columns of the kinds in ``_OPTIONAL`` exist
    only once they are used.
    """

    _OPTIONAL: ClassVar[dict[str, float]] = {"rate.": 1.0, "memory.": 0.0, "trace.": 0.0}
    """Prefix of the names of optional columns, one float per row -> value of rows for which it was
    not set."""

    device: torch.device

    def __init__(self, names: Iterable[str]):
        self._count = 0
        self._most = 0
        """Rows of the buffers that have ever been in use."""
        self._columns = {name: self._new_column(name, _FIRST_CAPACITY) for name in names}
        self._log: UndoLog | None = None

    def __len__(self) -> int:
        return self._count

    @property
    def columns(self) -> dict[str, Tensor]:
        """Every column by name, as views of the rows in use."""
        return {name: column[: self._count] for name, column in self._columns.items()}

    @property
    def rates(self) -> dict[str, Float[Tensor, " N"]]:
        """Parameter -> factor of its learning rate in each row, for the parameters that have
        any."""
        return self._optional("rate.")

    @property
    def memory(self) -> dict[str, Float[Tensor, " N"]]:
        """Numbers that a seeding rule keeps for each row, by name; see ``row_memory``."""
        return self._optional("memory.")

    def set_rate(self, parameter: str, factors: Float[Tensor, " N"]) -> None:
        """Set the factors by which the learning rate of a parameter is multiplied, one for each
        row."""
        self._use(f"rate.{parameter}")[: self._count] = factors

    def row_memory(self, name: str) -> Float[Tensor, " N"]:
        """A number for each row, 0 at first, which is removed, copied and saved together with its
        row; a view."""
        return self._use(f"memory.{name}")[: self._count]

    def trace_ids(self) -> Float[Tensor, " N"]:
        """A number for each row that an observer gives it, 0 at first; a view. It is removed and
        copied together with its row, and not saved."""
        return self._use("trace.id")[: self._count]

    def end_trace(self) -> None:
        """Remove the column of ``trace_ids``."""
        self._columns.pop("trace.id", None)

    def clear_memory(self, rows: MapRows) -> None:
        """Set all numbers of ``row_memory`` of these rows to zero."""
        for column in self.memory.values():
            column[rows] = 0.0

    def set_rows(
        self,
        name: str,
        rows: Int[Tensor, " M"],
        values: Tensor,
    ) -> None:
        """Write the values of some rows of a column, as they are stored."""
        self._columns[name][: self._count][rows] = values.to(self._columns[name])

    def copy_rows(self, rows: Int[Tensor, " M"]) -> None:
        """Append a copy of each of these rows; row numbers may repeat."""
        start = self._count
        stop = self._count + len(rows)
        self._reserve(stop)
        for column in self._columns.values():
            column[start:stop] = column[rows]
        self._in_use(stop)

    def keep(self, rows: Bool[Tensor, " N"]) -> None:
        """Remove every row where ``rows`` is false, in all columns alike; the order is kept."""
        check_shape("rows", rows, (self._count,))
        removed_rows = (~rows).nonzero()[:, 0]
        if not len(removed_rows):
            return
        first = int(removed_rows[0])  # rows before it stay where they are
        places = first + rows[first:].nonzero()[:, 0]
        self._count = first + len(places)
        for column in self._columns.values():
            column[first : self._count] = column.index_select(0, places)

    def log_changes(self) -> Callable[[], None]:
        """From now on ``will_change`` keeps rows, until ``end_log``. Returns a function that brings
        them back."""
        log = self._log = UndoLog(self._count, set(self._columns))

        def undo() -> None:
            for old_rows in reversed(log.entries):
                if isinstance(old_rows, dict):
                    self.restore(old_rows)
                else:
                    for name, values in old_rows[1].items():
                        self._columns[name][old_rows[0]] = values
            for name in set(self._columns) - log.names:
                del self._columns[name]
            self._count = log.count

        return undo

    def end_log(self) -> None:
        """What changes from now on cannot be undone."""
        self._log = None

    def will_change(self, rows: MapRows = ALL_ROWS) -> None:
        """Say that values of these rows will change, or with ``ALL_ROWS`` anything; new rows need
        not be said.

        Does nothing unless changes are logged.
        """
        log = self._log
        if log is None or log.has_all:
            return
        if isinstance(rows, slice):
            log.has_all = True
            log.entries.append(self.snapshot())
            return
        rows = rows[rows < log.count]
        if log.has_row is None:
            log.has_row = torch.zeros(log.count, dtype=torch.bool, device=self.device)
        rows = rows[~log.has_row[rows]]
        log.has_row[rows] = True
        if len(rows):
            log.entries.append(
                (rows, {name: c.index_select(0, rows) for name, c in self._columns.items()})
            )

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the rows, for ``restore``."""
        return {name: column.clone() for name, column in self.columns.items()}

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Go back to the rows of a ``snapshot``."""
        for name in set(self._columns) - set(snapshot):
            del self._columns[name]
        self._count = len(next(iter(snapshot.values())))
        for name, column in snapshot.items():
            self._columns[name][: self._count] = column

    def _optional(self, prefix: str) -> dict[str, Tensor]:
        columns = self._columns.items()
        return {
            name[len(prefix) :]: column[: self._count]
            for name, column in columns
            if name.startswith(prefix)
        }

    def _use(self, name: str) -> Tensor:
        """The buffer of an optional column, made when it is first used."""
        if name not in self._columns:
            self._columns[name] = self._new_buffer(name, self._capacity)
        return self._columns[name]

    def _fill_optional(self, rows: slice) -> None:
        """Give new rows the values for which nothing was set."""
        for prefix, value in self._OPTIONAL.items():
            for name in self._optional(prefix):
                self._columns[prefix + name][rows] = value

    def _in_use(self, count: int) -> None:
        self._most = max(self._most, count)
        self._count = count

    @property
    def _capacity(self) -> int:
        return next(iter(self._columns.values())).shape[0]

    def _reserve(self, count: int) -> None:
        if count <= self._capacity:
            return
        capacity = max(count, int(_GROWTH[self.device.type] * self._capacity))
        self._columns = {
            name: MAP_MEMORY.extend(column, capacity) for name, column in self._columns.items()
        }

    def _new_buffer(self, name: str, capacity: int) -> Tensor:
        for prefix, value in self._OPTIONAL.items():
            if name.startswith(prefix):
                return torch.full((capacity,), value, device=self.device)
        return self._new_column(name, capacity)

    def _new_column(self, name: str, capacity: int) -> Any:
        """A buffer of zeros for a column."""
        raise NotImplementedError
