"""Gaussians that are also surfels: opaque or transparent, stable or unstable (Peng et al. 2024,
section 3.1)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import ArgumentError
from ..geometry import quaternion
from ..types import GaussianParams, MapRows
from .columns import PARAMETERS
from .model import GaussianModel

OPAQUE = 0.99
"""Opacity of a Gaussian that represents the surface and its main colour."""

TRANSPARENT = 0.1
"""Opacity of a Gaussian that only corrects the remaining colour."""

UNSTABLE = 0

STABLE = 1

_ANCHOR = ("xyz_W", "log_scale", "quat")

_AT_LEAST_0 = ("state", "confidence", "colour_errors", "depth_errors", "frames_in_view")


def radius_of(scale_m: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Mean of the two largest standard deviations, metres: half of the largest sum of two."""
    a, b, c = scale_m.unbind(dim=1)
    return torch.maximum(torch.maximum(a + b, a + c), b + c) / 2


class SurfelModel(GaussianModel):
    """A Gaussian map whose rows are also surfels: normal, confidence count, birth frame, error
    counters, state.

    Opacity is set when a row is added and never changes. No moments are stored: each optimisation
    starts a new Adam, and ``step_count`` counts frames.

    Source: Peng et al. 2024 (RTG-SLAM), section 3.1.
    """

    _FLOATS = (*PARAMETERS, *(f"anchor.{name}" for name in _ANCHOR))
    _COUNTS = (*GaussianModel._COUNTS, *_AT_LEAST_0)

    @property
    def state(self) -> Int[Tensor, " N"]:
        """``UNSTABLE`` (0) or ``STABLE`` (1)."""
        return self.columns["state"]

    @property
    def confidence(self) -> Int[Tensor, " N"]:
        """Optimisation steps that changed the colour of each row; times the size of a step they are
        eta."""
        return self.columns["confidence"]

    @property
    def colour_errors(self) -> Int[Tensor, " N"]:
        """Number of frames in which the row's colour was wrong since it became stable."""
        return self.columns["colour_errors"]

    @property
    def depth_errors(self) -> Int[Tensor, " N"]:
        """Number of frames in which the row's depth was wrong since it became stable."""
        return self.columns["depth_errors"]

    @property
    def frames_in_view(self) -> Int[Tensor, " N"]:
        """Number of frames with the row's centre in view since it was added or last became
        unstable."""
        return self.columns["frames_in_view"]

    @property
    def is_stable(self) -> Bool[Tensor, " N"]:
        """Rows that are no longer optimised."""
        return self.state == STABLE

    @property
    def is_transparent(self) -> Bool[Tensor, " N"]:
        """Rows that only correct colour; never hit by a ray."""
        return self.params.opacity_logit < 0

    @property
    def normal_W(self) -> Float[Tensor, "N 3"]:
        """Axis of the smallest scale, unit vector in the world frame; its sign is arbitrary."""
        R = quaternion.to_matrix(self.params.quat)
        thin = self.params.log_scale.argmin(dim=1)
        return R.gather(2, thin[:, None, None].expand(-1, 3, 1)).squeeze(2)

    @property
    def radius_m(self) -> Float[Tensor, " N"]:
        """Mean of the two largest standard deviations, metres."""
        return radius_of(self.scale_m)

    @property
    def anchor(self) -> dict[str, Tensor]:
        """Centre, log-scale and quaternion when added; the regulariser keeps transparent rows close
        to them (Eq. 8)."""
        return {name: self.columns[f"anchor.{name}"] for name in _ANCHOR}

    def extend(self, params: GaussianParams, frame_index: int = -1) -> None:
        """Refused: the opacity of a disc is one of two constants, and its thinnest axis is a
        normal.

        Raises:
            ValueError: always.
        """
        raise ArgumentError(
            "RTG-SLAM cannot begin with Gaussians of another program, because its own are discs "
            "with one of two opacities; use --system gsfusion"
        )

    def set_rows(
        self,
        name: str,
        rows: Int[Tensor, " M"],
        values: Tensor,
    ) -> None:
        """Also: geometry that is set is where the regulariser holds a transparent row; a new state
        starts its counts again, as in ``change_states``."""
        super().set_rows(name, rows, values)
        if name in _ANCHOR:
            super().set_rows(f"anchor.{name}", rows, values)
        if name == "state":
            self.colour_errors[rows] = 0
            self.depth_errors[rows] = 0
            unstable_rows = rows[self.state[rows] == UNSTABLE]
            self.confidence[unstable_rows] = 0
            self.frames_in_view[unstable_rows] = 0
            super().as_new(unstable_rows)

    def as_new(self, rows: MapRows) -> None:
        """Count these rows as added now: unstable, confidence 0, no errors, held where they are."""
        super().as_new(rows)
        for name in _AT_LEAST_0:
            self.columns[name][rows] = 0
        for name in _ANCHOR:
            self.anchor[name][rows] = self.columns[name][rows]
