"""The compact Gaussian map of RTG-SLAM: every Gaussian is a disc, opaque or transparent, stable or unstable."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import quaternion
from ..types import GaussianParams, Seeds
from .model import GaussianModel

OPAQUE = 0.99
"""Opacity of a Gaussian that represents the surface and its main colour."""
TRANSPARENT = 0.1
"""Opacity of a Gaussian that only corrects the remaining colour."""
UNSTABLE, STABLE = 0, 1

_ANCHOR = ("xyz_W", "log_scale", "quat")
_AT_LEAST_0 = ("state", "confidence", "colour_errors", "depth_errors", "frames_in_view")


class SurfelModel(GaussianModel):
    """A Gaussian map whose rows are also surfels: normal, confidence count, birth frame, error counters, state.

    Opacity is set when a row is added and never changes. No moments are stored: each optimisation starts a new Adam,
    and ``step_count`` counts frames.

    Source: Peng et al. 2024 (RTG-SLAM), section 3.1.
    """

    _COUNTS = (*GaussianModel._COUNTS, *_AT_LEAST_0)
    _MOMENTS = ()
    _POSE_PREFIXES = ("", "anchor.")
    TAG_MEANING = "why the row was added"

    @property
    def state(self) -> Int[Tensor, " N"]:
        """``UNSTABLE`` (0) or ``STABLE`` (1)."""
        return self._columns["state"][: len(self)]

    @property
    def confidence(self) -> Int[Tensor, " N"]:
        """eta: number of optimisation steps that changed the colour of each row."""
        return self._columns["confidence"][: len(self)]

    @property
    def colour_errors(self) -> Int[Tensor, " N"]:
        """Number of frames in which the row's colour was wrong since it became stable."""
        return self._columns["colour_errors"][: len(self)]

    @property
    def depth_errors(self) -> Int[Tensor, " N"]:
        """Number of frames in which the row's depth was wrong since it became stable."""
        return self._columns["depth_errors"][: len(self)]

    @property
    def frames_in_view(self) -> Int[Tensor, " N"]:
        """Number of frames with the row's centre in view since it was added or last became unstable."""
        return self._columns["frames_in_view"][: len(self)]

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
        return self.scale_m.sort(dim=-1).values[:, 1:].mean(dim=-1)

    @property
    def anchor(self) -> dict[str, Tensor]:
        """Centre, log-scale and quaternion when added; the regulariser keeps transparent rows close to them (Eq. 8)."""
        return {name: self._columns[f"anchor.{name}"][: len(self)] for name in _ANCHOR}

    def extend(self, params: GaussianParams, frame_index: int = -1) -> None:
        """Refused: the opacity of a disc is one of two constants, and its thinnest axis is a normal.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "RTG-SLAM cannot begin with Gaussians of another program, because its own are discs with one of "
            "two opacities; use --system gsfusion"
        )

    def append(self, seeds: Seeds, frame_index: int = 0) -> None:
        """Add rows: unstable, confidence 0, no errors."""
        start = len(self)
        super().append(seeds, frame_index)
        self.as_new(slice(start, len(self)))

    def set_rows(self, name: str, rows: Int[Tensor, " M"], values: Tensor) -> None:
        """Also: geometry that is set is where the regulariser holds a transparent row; a new state starts its counts
        again, as in ``change_states``."""
        super().set_rows(name, rows, values)
        if name in _ANCHOR:
            super().set_rows(f"anchor.{name}", rows, values)
        if name == "state":
            self.colour_errors[rows] = 0
            self.depth_errors[rows] = 0
            released = rows[self.state[rows] == UNSTABLE]
            self.confidence[released] = 0
            self.frames_in_view[released] = 0
            super().as_new(released)

    def as_new(self, rows: Int[Tensor, " M"] | slice) -> None:
        """Count these rows as added now: unstable, confidence 0, no errors, held where they are."""
        super().as_new(rows)
        for name in _AT_LEAST_0:
            self._columns[name][: len(self)][rows] = 0
        for name in _ANCHOR:
            self.anchor[name][rows] = self._columns[name][: len(self)][rows]

    def _check_saved_column(self, name: str, saved: object, shape: tuple[int, ...]) -> None:
        super()._check_saved_column(name, saved, shape)
        if name in _AT_LEAST_0 and shape[0]:
            assert isinstance(saved, Tensor)
            low, high = int(saved.min()), int(saved.max())
            if low < 0 or (name == "state" and high > STABLE):
                wanted = "0 (unstable) or 1 (stable)" if name == "state" else "at least 0"
                raise ValueError(f"{name} must be {wanted} in every row, got {low} to {high}")

    def _column_names(self) -> list[str]:
        return [*super()._column_names(), *(f"anchor.{name}" for name in _ANCHOR)]


def state_counts(model: SurfelModel) -> dict[str, int]:
    """Rows by state and kind, for reports."""
    stable, transparent = model.is_stable, model.is_transparent
    kinds = {
        "stable_opaque": stable & ~transparent,
        "stable_transparent": stable & transparent,
        "unstable_opaque": ~stable & ~transparent,
        "unstable_transparent": ~stable & transparent,
    }
    counts = torch.stack(list(kinds.values())).sum(dim=1).tolist()  # the host waits for a GPU once
    return dict(zip(kinds, counts, strict=True))
