"""Gaussians that a gradient step made NaN or infinite: they are found, counted, and said."""

from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from ..types import GaussianParams


class LostRows:
    """Counts the Gaussians of a map that a step made NaN or infinite.

    After each step only sums are kept, so that a GPU does not have to wait; rows are looked at if a
    sum is not finite.
    """

    def __init__(self) -> None:
        self.total = 0
        """Gaussians that were lost so far."""
        self.in_frame = 0
        """Of these, those of the frame that is mapped, or of the passes after the scan."""
        self._sums: list[Tensor] = []

    @property
    def counts(self) -> tuple[int, int]:
        """``total`` and ``in_frame``."""
        return self.total, self.in_frame

    @counts.setter
    def counts(self, counts: tuple[int, int]) -> None:
        self.total, self.in_frame = counts

    def begin_frame(self) -> None:
        """From now on steps belong to another frame."""
        self.in_frame = 0
        self._sums = []

    def stepped(self, params: GaussianParams) -> None:
        """Remember a step that changed these rows."""
        self._sums.append(torch.stack([column.sum() for column in vars(params).values()]).sum())

    def count(self, params: GaussianParams) -> Bool[Tensor, " N"] | None:
        """Count the lost rows of the steps since the last call.

        Args:
            params: All rows of the map, with the values after these steps.

        Returns:
            Which rows are finite; None: all of them. [N]
        """
        sums = self._sums
        self._sums = []
        if not sums or bool(torch.stack(sums).isfinite().all()):
            return None
        finite = finite_rows(params)
        n = int((~finite).sum())
        self.total += n
        self.in_frame += n
        return finite if n else None

    def in_words(self, where: str) -> str:
        """A sentence for the user about the Gaussians that were lost in a frame, or in the
        passes."""
        return (
            f"{where}: {self.in_frame:,} Gaussians became NaN or infinite in gradient steps and "
            "were removed; look for wrong depth or poses (gsfusion-nb check) or try smaller "
            "learning rates; metrics.json counts all as n_not_finite"
        )


def remove_lost(mapper: Any) -> Bool[Tensor, " N"] | None:
    """Remove the Gaussians of a mapper's map that the last steps made NaN or infinite, and count
    them.

    Returns:
        Which rows of the map before stay; None: all of them. [N]
    """
    finite = mapper.lost.count(mapper.gaussians.params)
    if finite is not None:
        mapper.gaussians.undo_log.will_change()
        mapper.gaussians.keep(finite)
        mapper.parts.rows_changed(finite.nonzero()[:, 0])
    return finite


def finite_rows(params: GaussianParams) -> Bool[Tensor, " N"]:
    """Rows all of whose values are finite. [N]"""
    finite = torch.ones(
        len(params),
        dtype=torch.bool,
        device=params.xyz_W.device,
    )
    for column in vars(params).values():
        finite &= column.isfinite().flatten(1).all(1) if column.ndim > 1 else column.isfinite()
    return finite
