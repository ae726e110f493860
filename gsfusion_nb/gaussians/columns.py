"""The columns of a Gaussian map, which grow together: a row is added, copied and removed in all of
them."""

from collections.abc import Collection, Iterator, Mapping

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..checks import check_shape
from ..resources import MAP_MEMORY
from ..types import GaussianParams

PARAMETERS = tuple(GaussianParams.__dataclass_fields__)

Layout = Mapping[str, tuple[tuple[int, ...], torch.dtype]]
"""Name of a column -> shape of a row, and type."""

_FIRST_CAPACITY = 4096
_GROWTH = {"cpu": 2.0, "cuda": 1.25}
"""Rows that are full grow by this factor. Untouched memory is free on a CPU; on a GPU it is taken
from the rest."""


class GaussianColumns(Mapping[str, Tensor]):
    """Name -> column, as a view of the rows in use, in buffers that grow by a factor when full.

    Args:
        layout: The columns. Their rows begin as zeros.
        device: Where they are.
    """

    def __init__(self, layout: Layout, device: torch.device):
        self.n_rows = 0
        """Rows in use."""
        self.device = device
        self._most_rows = 0
        """Rows of the buffers that have ever been in use."""
        self._capacity = _FIRST_CAPACITY
        """Rows of the buffers."""
        self._buffers = {
            name: MAP_MEMORY.rows(_FIRST_CAPACITY, *shape, dtype=dtype, device=device)
            for name, (shape, dtype) in layout.items()
        }
        self._parameters: dict[str, tuple[Tensor, GaussianParams]] = {}
        """Prefix -> buffer of the last column when they were made, and views of the rows in use."""

    def __getitem__(self, name: str) -> Tensor:
        return self._buffers[name][: self.n_rows]

    def __iter__(self) -> Iterator[str]:
        return iter(self._buffers)

    def __len__(self) -> int:
        return len(self._buffers)

    def parameters(self, prefix: str = "") -> GaussianParams:
        """The columns ``prefix`` + name of a parameter; the same views until the number of rows
        changes."""
        last = self._buffers[prefix + PARAMETERS[-1]]
        buffer, views = self._parameters.get(prefix, (None, None))
        if (
            views is not None
            and buffer is last
            and len(views) == self.n_rows
            # somebody may have asked for a derivative of one
            and not any(column.requires_grad for column in vars(views).values())
        ):
            return views
        views = GaussianParams(**{name: self[prefix + name] for name in PARAMETERS})
        self._parameters[prefix] = (last, views)
        return views

    def buffers(self) -> Collection[Tensor]:
        """What the columns are views of: whether they were changed is asked of these."""
        return self._buffers.values()

    def add(self, name: str, value: float) -> None:
        """One more column, of one float in each row, which all have this value."""
        self._buffers[name] = torch.full((self._capacity,), value, device=self.device)

    def remove(self, name: str) -> None:
        """Remove a column, if it is there."""
        self._buffers.pop(name, None)

    def new_rows(self, n: int) -> slice:
        """Append ``n`` rows of zeros; returns which they are."""
        were_used = self.n_rows < self._most_rows  # rows that were never in use are zero
        rows = self._more_rows(n)
        if were_used:
            for buffer in self._buffers.values():
                buffer[rows] = 0
        return rows

    def copy_rows(self, rows: Int[Tensor, " M"]) -> slice:
        """Append a copy of each of these rows, which may repeat; returns which the copies are."""
        copies = self._more_rows(len(rows))
        for buffer in self._buffers.values():
            buffer[copies] = buffer[rows]
        return copies

    def keep(self, rows: Bool[Tensor, " N"]) -> None:
        """Remove every row where ``rows`` is false; the order is kept."""
        check_shape("rows", rows, (self.n_rows,))
        removed_rows = (~rows).nonzero()[:, 0]
        if not len(removed_rows):
            return
        first = int(removed_rows[0])  # rows before it stay where they are
        places = first + rows[first:].nonzero()[:, 0]
        self.n_rows = first + len(places)
        for buffer in self._buffers.values():
            buffer[first : self.n_rows] = buffer.index_select(0, places)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the rows, for ``restore``."""
        return {name: column.clone() for name, column in self.items()}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Go back to the rows of a ``snapshot``."""
        for name in set(self._buffers) - set(snapshot):
            self.remove(name)
        self.n_rows = len(next(iter(snapshot.values())))
        for name, column in snapshot.items():
            self[name][:] = column

    def _more_rows(self, n: int) -> slice:
        """Use ``n`` more rows, whatever is in them; returns which they are."""
        rows = slice(self.n_rows, self.n_rows + n)
        if rows.stop > self._capacity:
            capacity = max(rows.stop, int(_GROWTH[self.device.type] * self._capacity))
            self._parameters.clear()  # views of the old buffers
            self._buffers = {
                name: MAP_MEMORY.extend(buffer, capacity) for name, buffer in self._buffers.items()
            }
            self._capacity = capacity
        self.n_rows = rows.stop
        self._most_rows = max(self._most_rows, self.n_rows)
        return rows


class OptionalColumns(Mapping[str, Tensor]):
    """Columns of one kind that exist only once they are used, one float in each row.

    Args:
        columns: All columns of the map.
        prefix: Of their names in ``columns``.
        value: Of rows for which nothing was set.
    """

    def __init__(self, columns: GaussianColumns, prefix: str, value: float):
        self._columns = columns
        self._prefix = prefix
        self._value = value

    def __getitem__(self, name: str) -> Tensor:
        return self._columns[self._prefix + name]

    def __iter__(self) -> Iterator[str]:
        n = len(self._prefix)
        return (name[n:] for name in self._columns if name.startswith(self._prefix))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def use(self, name: str) -> Tensor:
        """The column of this name, made when it is first used; a view."""
        if name not in self:
            self._columns.add(self._prefix + name, self._value)
        return self[name]

    def reset(self, rows: slice | Tensor) -> None:
        """Give these rows the value for which nothing was set, in every column."""
        for column in self.values():
            column[rows] = self._value

    def remove(self, name: str) -> None:
        """Remove the column of this name, if it is there."""
        self._columns.remove(self._prefix + name)
