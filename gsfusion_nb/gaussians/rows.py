"""Columns of one length that grow together: a row is added, copied, removed and saved in all of them."""

from collections.abc import Iterable
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..checks import check_shape
from ..constants import GROWTH

_FIRST_CAPACITY = 4096


class GrowingRows:
    """Rows in buffers that grow by a factor when full; what is given out are views of the rows in use.

    A subclass defines ``device`` and ``_new_column``. Columns of the kinds in ``_OPTIONAL`` exist only once they are
    used.
    """

    _OPTIONAL: ClassVar[dict[str, float]] = {"rate.": 1.0, "memory.": 0.0, "trace.": 0.0}
    """Prefix of the names of optional columns, one float per row -> value of rows for which it was not set."""

    device: torch.device

    def __init__(self, names: Iterable[str]):
        self._count = 0
        self._most = 0
        """Rows of the buffers that have ever been in use."""
        self._columns = {name: self._new_column(name, _FIRST_CAPACITY) for name in names}

    def __len__(self) -> int:
        return self._count

    @property
    def columns(self) -> dict[str, Tensor]:
        """Every column by name, as views of the rows in use."""
        return {name: column[: self._count] for name, column in self._columns.items()}

    @property
    def rates(self) -> dict[str, Float[Tensor, " N"]]:
        """Parameter -> factor of its learning rate in each row, for the parameters that have any."""
        return self._optional("rate.")

    @property
    def memory(self) -> dict[str, Float[Tensor, " N"]]:
        """Numbers that a seeding rule keeps for each row, by name; see ``row_memory``."""
        return self._optional("memory.")

    @property
    def memory_bytes(self) -> int:
        """Memory of all columns with the spare rows, bytes."""
        return sum(column.nbytes for column in self._columns.values())

    def set_rate(self, parameter: str, factors: Float[Tensor, " N"]) -> None:
        """Set the factors by which the learning rate of a parameter is multiplied, one for each row."""
        self._use(f"rate.{parameter}")[: self._count] = factors

    def row_memory(self, name: str) -> Float[Tensor, " N"]:
        """A number for each row, 0 at first, which is removed, copied and saved together with its row; a view."""
        return self._use(f"memory.{name}")[: self._count]

    def trace_ids(self) -> Float[Tensor, " N"]:
        """A number for each row that an observer gives it, 0 at first; a view. It is removed and copied together with
        its row, and not saved."""
        return self._use("trace.id")[: self._count]

    def end_trace(self) -> None:
        """Remove the column of ``trace_ids``."""
        self._columns.pop("trace.id", None)

    def clear_memory(self, rows: Int[Tensor, " M"] | slice) -> None:
        """Set all numbers of ``row_memory`` of these rows to zero."""
        for column in self.memory.values():
            column[rows] = 0.0

    def set_rows(self, name: str, rows: Int[Tensor, " M"], values: Tensor) -> None:
        """Write the values of some rows of a column, as they are stored."""
        self._columns[name][: self._count][rows] = values.to(self._columns[name])

    def copy_rows(self, rows: Int[Tensor, " M"]) -> None:
        """Append a copy of each of these rows; row numbers may repeat."""
        start, stop = self._count, self._count + len(rows)
        self._reserve(stop)
        for column in self._columns.values():
            column[start:stop] = column[rows]
        self._in_use(stop)

    def keep(self, rows: Bool[Tensor, " N"]) -> None:
        """Remove every row where ``rows`` is false, in all columns alike; the order is kept."""
        check_shape("rows", rows, (self._count,))
        kept = int(rows.sum())
        for column in self._columns.values():
            column[:kept] = column[: self._count][rows]
        self._count = kept

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
        return {name[len(prefix) :]: column[: self._count] for name, column in columns if name.startswith(prefix)}

    def _use(self, name: str) -> Tensor:
        """The buffer of an optional column, made when it is first used."""
        if name not in self._columns:
            self._columns[name] = self._made(name, self._capacity)
        return self._columns[name]

    def _fill_optional(self, rows: slice) -> None:
        """Give new rows the values for which nothing was set."""
        for prefix, value in self._OPTIONAL.items():
            for name in self._optional(prefix):
                self._columns[prefix + name][rows] = value

    def _in_use(self, count: int) -> None:
        self._count, self._most = count, max(self._most, count)

    @property
    def _capacity(self) -> int:
        return next(iter(self._columns.values())).shape[0]

    def _reserve(self, count: int) -> None:
        if count <= self._capacity:
            return
        capacity = max(count, int(GROWTH[self.device.type] * self._capacity))
        for name, old in list(self._columns.items()):
            grown = self._made(name, capacity)
            grown[: self._count] = old[: self._count]
            self._columns[name] = grown
        self._most = self._count

    def _made(self, name: str, capacity: int) -> Tensor:
        for prefix, value in self._OPTIONAL.items():
            if name.startswith(prefix):
                return torch.full((capacity,), value, device=self.device)
        return self._new_column(name, capacity)

    def _new_column(self, name: str, capacity: int) -> Any:
        """A buffer of zeros for a column."""
        raise NotImplementedError
