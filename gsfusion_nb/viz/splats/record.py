"""All numbers of one Gaussian as a readable table."""

from dataclasses import dataclass

import torch

from ...constants import SH_C0
from ...drawing.html import fill
from ...types import GaussianParams
from .columns import Column


@dataclass(frozen=True, kw_only=True)
class GaussianRecord:
    """One row of a map, activated values. ``str(row)`` and the notebook show it as a small table."""

    row: int
    """Its number in the map."""
    xyz_W: tuple[float, ...]
    """Centre, metres."""
    scale_m: tuple[float, ...]
    """Standard deviations along its own axes, metres."""
    quat: tuple[float, ...]
    """Orientation, wxyz, unit length."""
    opacity: float
    """Peak opacity."""
    rgb: tuple[float, ...]
    """View-independent part of the colour, 0..1 unless it left that range."""
    sh_degree: int
    """Degree of the view-dependent part."""
    extras: dict[str, float]
    """Birth frame, seed level, and the other columns of the viewer."""

    def lines(self) -> list[tuple[str, str]]:
        """Names and values, rounded for reading."""
        triples = {"xyz_W [m]": self.xyz_W, "scale_m [m]": self.scale_m, "quat (wxyz)": self.quat, "rgb": self.rgb}
        rows = [("row", f"{self.row:,}")]
        rows += [(name, "  ".join(f"{v:.4g}" for v in values)) for name, values in triples.items()]
        rows += [("opacity", f"{self.opacity:.4g}"), ("sh degree", str(self.sh_degree))]
        return rows + [(name, f"{value:.4g}") for name, value in self.extras.items()]

    def __str__(self) -> str:
        return "\n".join(f"{name:<12} {value}" for name, value in self.lines())

    def _repr_html_(self) -> str:
        return fill("splat_record.html", lines=self.lines())


def gaussian_record(params: GaussianParams, columns: list[Column], row: int) -> GaussianRecord:
    """The record of one row.

    Raises:
        IndexError: no such row.
    """
    if not 0 <= row < len(params):
        raise IndexError(f"row must be between 0 and {len(params) - 1}, got {row}")
    one = params[row : row + 1]
    unit = torch.nn.functional.normalize(one.quat[0].double(), dim=0)

    def numbers(values: torch.Tensor) -> tuple[float, ...]:
        return tuple(float(v) for v in values)

    return GaussianRecord(
        row=row,
        xyz_W=numbers(one.xyz_W[0]),
        scale_m=numbers(one.log_scale[0].exp()),
        quat=numbers(unit),
        opacity=float(one.opacity_logit[0].sigmoid()),
        rgb=numbers(one.sh[0, 0] * SH_C0 + 0.5),
        sh_degree=params.sh_degree,
        extras={c.name: float(c.values[row]) for c in columns},
    )
