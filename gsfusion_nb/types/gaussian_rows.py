"""Gaussians as columns, one row each: those of a map, and those that a rule proposes."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

MapRows = slice | Int[Tensor, " R"]
"""A part of a map: numbers of its rows, each once, or a slice, such as ``ALL_ROWS``. Columns are
indexed by it."""


ALL_ROWS = slice(None)
"""A map as a whole: a column that is indexed by it is a view, not a copy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianParams:
    """The optimised numbers of a Gaussian map, one row each, before activation. Gradients have the
    same shape.

    A row stands for the density G(x) = exp(-(x - xyz_W)^T Sigma^-1 (x - xyz_W) / 2) (GSFusion Eq.
    1).
    """

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    log_scale: Float[Tensor, "N 3"]
    """Logarithm of the standard deviation in metres, along the Gaussian's own axes."""
    quat: Float[Tensor, "N 4"]
    """Orientation, wxyz, normalised at use."""
    opacity_logit: Float[Tensor, " N"]
    """Logit of the peak opacity."""
    sh: Float[Tensor, "N K 3"]
    """Spherical-harmonic coefficients of the colour; K = (degree + 1)^2, coefficient 0 is the
    constant one."""

    def __len__(self) -> int:
        return self.xyz_W.shape[0]

    def __getitem__(self, rows) -> "GaussianParams":
        return GaussianParams(**_rows_of(vars(self), rows))

    @property
    def sh_degree(self) -> int:
        """Degree of the colour's spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5) - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeds:
    """New Gaussians, one row each, as a seeding rule proposes them. ``seeds[mask]`` filters every
    column at once."""

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    rgb: Float[Tensor, "N 3"]
    """Colour, 0..1."""
    scale_m: Float[Tensor, "N 3"]
    """Standard deviation along the Gaussian's own axes, metres."""
    quat: Float[Tensor, "N 4"]
    """Orientation, wxyz."""
    opacity: Float[Tensor, " N"]
    """Peak opacity, in (0, 1)."""
    tag: Int[Tensor, " N"]
    """Free label carried into the map; the quadtree rules put the cell's depth in the tree here."""

    def __len__(self) -> int:
        return self.xyz_W.shape[0]

    def __getitem__(self, rows) -> "Seeds":
        return Seeds(**_rows_of(vars(self), rows))

    @staticmethod
    def isotropic(
        xyz_W: Float[Tensor, "N 3"],
        rgb: Float[Tensor, "N 3"],
        radius_m: Float[Tensor, " N"],
        *,
        opacity: float = 0.5,
        tag: Int[Tensor, " N"] | None = None,
    ) -> "Seeds":
        """Round Gaussians with identity orientation (GSFusion III-B.2: R = I, S = diag(d, d, d),
        alpha = 0.5)."""
        n = xyz_W.shape[0]
        quat = xyz_W.new_zeros(n, 4)
        quat[:, 0] = 1.0
        return Seeds(
            xyz_W=xyz_W,
            rgb=rgb,
            scale_m=radius_m[:, None].expand(n, 3).clone(),
            quat=quat,
            opacity=xyz_W.new_full((n,), opacity),
            tag=torch.zeros(n, dtype=torch.int32, device=xyz_W.device)
            if tag is None
            else tag.to(torch.int32),
        )

    @staticmethod
    def empty(like: Tensor | None = None) -> "Seeds":
        """No rows, on the device of ``like``."""
        zeros = torch.zeros if like is None else like.new_zeros
        return Seeds.isotropic(
            zeros((0, 3)),
            zeros((0, 3)),
            zeros((0,)),
        )

    @staticmethod
    def cat(parts: "list[Seeds]") -> "Seeds":
        """Rows of all ``parts``, in order."""
        if not parts:
            return Seeds.empty()
        return Seeds(
            **{
                f.name: torch.cat([getattr(p, f.name) for p in parts])
                for f in dataclasses.fields(Seeds)
            }
        )


def _rows_of(columns: dict[str, Tensor], rows: Any) -> dict[str, Tensor]:
    """Rows of every column. A mask is searched once, and whole rows are copied faster than by
    indexing."""
    if isinstance(rows, Tensor) and rows.ndim == 1 and rows.dtype in (torch.bool, torch.int64):
        n = len(next(iter(columns.values())))
        places = (
            rows.nonzero()[:, 0]
            if rows.dtype == torch.bool
            else torch.where(rows < 0, rows + n, rows)
        )
        return {
            name: column.index_select(0, places.to(column.device))
            for name, column in columns.items()
        }
    return {name: column[rows] for name, column in columns.items()}
