"""Adam's moments of a Gaussian map, which are columns beside its parameters."""

from dataclasses import dataclass
from typing import Any

from ..types import ALL_ROWS, GaussianParams, MapRows

MOMENTS = ("exp_avg.", "exp_avg_sq.")
"""Prefixes of their columns; the name of a parameter follows."""


@dataclass(frozen=True, eq=False)
class Moments:
    """What Adam remembers of each parameter of each row."""

    exp_avg: GaussianParams
    """Running mean of the gradient."""
    exp_avg_sq: GaussianParams
    """Running mean of the squared gradient."""

    def __getitem__(self, rows: MapRows) -> "Moments":
        return Moments(self.exp_avg[rows], self.exp_avg_sq[rows])


def clear_moments(model: Any, rows: MapRows = ALL_ROWS, parameter: str = "") -> None:
    """Set Adam's moments of these rows of a ``GaussianModel`` to zero.

    Args:
        model: The map.
        rows: Its rows.
        parameter: Only the moments of this one; "": of all.
    """
    for name, column in model.columns.items():
        if name.startswith(MOMENTS) and name.endswith(parameter):
            column[rows] = 0.0


def restart_optimiser(model: Any) -> None:
    """Forget all moments; the steps of every row are counted from here."""
    clear_moments(model)
    model.clock.begin(ALL_ROWS)
