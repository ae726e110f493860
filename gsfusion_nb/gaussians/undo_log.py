"""Rows of a Gaussian map as they were before a frame changed them, and how they come back."""

from collections.abc import Callable

import torch
from torch import Tensor

from ..types import ALL_ROWS, MapRows
from .columns import GaussianColumns
from .step_clock import StepCount


class UndoLog:
    """Keeps rows before they change, between ``begin`` and ``end``; else it does nothing.

    Args:
        columns: The columns of the map.
        steps: The number of steps of its optimiser, which is brought back as well.
    """

    def __init__(self, columns: GaussianColumns, steps: StepCount):
        self._columns = columns
        self._steps = steps
        self._changes: _Changes | None = None

    def begin(self) -> Callable[[], None]:
        """From now on ``will_change`` keeps rows, until ``end``. Returns a function that brings
        them back."""
        changes = self._changes = _Changes(self._columns)
        n_steps = self._steps.value

        def undo() -> None:
            changes.undo(self._columns)
            self._steps.value = n_steps

        return undo

    def end(self) -> None:
        """What changes from now on cannot be undone."""
        self._changes = None

    def will_change(self, rows: MapRows = ALL_ROWS) -> None:
        """Say that values of these rows will change, or with ``ALL_ROWS`` anything; new rows need
        not be said."""
        if self._changes is not None:
            self._changes.keep(rows, self._columns)


class _Changes:
    """Rows as they were before they were changed."""

    def __init__(self, columns: GaussianColumns):
        self._n_rows = columns.n_rows
        self._names = set(columns)
        self._entries: list[dict[str, Tensor] | tuple[Tensor, dict[str, Tensor]]] = []
        """Rows and their values, or a whole ``snapshot``, in the order of the changes."""
        self._has_row: Tensor | None = None
        """Which rows are in it; None before the first."""
        self._has_all = False

    def keep(self, rows: MapRows, columns: GaussianColumns) -> None:
        """Keep these rows, unless they are kept."""
        if self._has_all:
            return
        if isinstance(rows, slice):
            self._has_all = True
            self._entries.append(columns.snapshot())
            return
        rows = rows[rows < self._n_rows]
        if self._has_row is None:
            self._has_row = torch.zeros(self._n_rows, dtype=torch.bool, device=columns.device)
        rows = rows[~self._has_row[rows]]
        self._has_row[rows] = True
        if len(rows):
            values = {name: column.index_select(0, rows) for name, column in columns.items()}
            self._entries.append((rows, values))

    def undo(self, columns: GaussianColumns) -> None:
        """Bring the rows back."""
        for entry in reversed(self._entries):
            if isinstance(entry, dict):
                columns.restore(entry)
                continue
            rows, values = entry
            columns.n_rows = max(columns.n_rows, self._n_rows)
            for name, column in values.items():
                columns[name][rows] = column
        for name in set(columns) - self._names:
            columns.remove(name)
        columns.n_rows = self._n_rows
