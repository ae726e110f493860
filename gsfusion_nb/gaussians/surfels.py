"""The compact Gaussian map of RTG-SLAM: every Gaussian is a disc, opaque or transparent, stable or
unstable.

``change_states`` decides when a Gaussian becomes stable or unstable, or is removed (Peng et al.
2024, section 3.2, "State management"), and ``fuse_with_history`` keeps earlier views from being
forgotten (Eq. 9).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import piece
from ..config import StateConfig
from ..errors import ArgumentError
from ..geometry import project, quaternion, se3, sum_rows
from ..types import ALL_ROWS, Camera, GaussianParams, MapRows
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


def state_counts(model: SurfelModel) -> dict[str, int]:
    """Rows by state and kind, for reports."""
    stable = model.is_stable
    transparent = model.is_transparent
    kinds = {
        "stable_opaque": stable & ~transparent,
        "stable_transparent": stable & transparent,
        "unstable_opaque": ~stable & ~transparent,
        "unstable_transparent": ~stable & transparent,
    }
    # the host waits for a GPU once
    counts = torch.stack([kind.count_nonzero() for kind in kinds.values()]).tolist()
    return dict(zip(kinds, counts, strict=True))


STAYS = 0
BECOMES_STABLE = 1
BECOMES_UNSTABLE = 2
DELETED = 3
"""What happens to a row at the end of a frame."""


@dataclass(frozen=True, kw_only=True)
class Transitions:
    """How many rows changed state in one frame."""

    stabilised: int
    """Unstable rows that became stable."""
    released: int
    """Stable rows with too many errors, which became unstable again (or were deleted,
    ``on_error="delete"``)."""
    expired: int
    """Rows removed because they were unstable for too long."""
    oversized: int
    """Rows removed because their radius was too large."""


def count_errors(
    model: SurfelModel,
    colour_error: Float[Tensor, "H W"],
    colour_index: Int[Tensor, "H W"],
    depth_error_m: Float[Tensor, "H W"],
    depth_index: Int[Tensor, "H W"],
    config: StateConfig,
) -> None:
    """Add 1 to the error count e_i of every stable row that is wrong in this frame, for colour and
    for depth.

    A row is wrong if the largest error among its pixels is above the threshold.

    Args:
        model: The map; its counters change.
        colour_error: Mean absolute difference over R, G, B, 0 where it should not count. [H, W]
        colour_index: Row that dominates each pixel's colour, or -1. [H, W]
        depth_error_m: Measured minus rendered depth, 0 where it should not count, metres. [H, W]
        depth_index: Row that each pixel's ray hits, or -1. [H, W]
        config: Thresholds.
    """
    depth_error = depth_error_m if config.on_error == "delete" else depth_error_m.abs()
    for counter, error, index, limit in (
        (model.colour_errors, colour_error, colour_index, config.colour_error),
        (model.depth_errors, depth_error, depth_index, config.depth_error_m),
    ):
        wrong = torch.zeros_like(counter, dtype=torch.bool)
        wrong[index[(index >= 0) & (error > limit)].long()] = True
        counter += wrong & model.is_stable


def count_views(
    model: SurfelModel,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    rows: MapRows = ALL_ROWS,
) -> None:
    """Add 1 to ``frames_in_view`` of every row whose centre is in front of the camera and in the
    image, even if hidden.

    Args:
        model: The map; its counter changes.
        camera: Intrinsics and size.
        T_WC: Camera-to-world pose.
        rows: Rows that may be in the image.
    """
    xyz_C = se3.apply(se3.inverse(T_WC), model.params.xyz_W[rows])
    u, v = project(camera, xyz_C).unbind(-1)
    in_view = (xyz_C[:, 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    model.frames_in_view[rows] += in_view


def change_states(
    model: SurfelModel, config: StateConfig, confidence_per_step: float = 1.0
) -> Transitions:
    """Unstable -> stable by confidence, stable -> unstable by errors, and removal of bad rows.

        eta_i > delta_eta                  unstable becomes stable
        e_i   > delta_e                    stable becomes unstable; confidence and age start again
        k - t_i > delta_t                  unstable is removed
        r_i   > max_radius_factor mean(r)  removed, stable or not (released code; not in the paper)

    eta_i is a number of steps times ``confidence_per_step``. ``config.age`` says which frames count
    in k - t_i.
    """
    stable = model.is_stable
    age = model.frames_in_view if config.age == "in_view" else model.step_count - model.clock.birth
    errors = model.depth_errors
    if config.on_error == "release":
        errors = errors.maximum(model.colour_errors)
    happens = next_states(
        stable,
        model.confidence,
        errors,
        age,
        stable_confidence=config.stable_confidence / confidence_per_step
        if confidence_per_step
        else math.inf,
        error_count=config.error_count,
        unstable_frames=config.unstable_frames,
    )
    rows = happens.nonzero()[:, 0]  # few
    ready, wrong, is_expired = (
        rows[happens[rows] == what] for what in (BECOMES_STABLE, BECOMES_UNSTABLE, DELETED)
    )
    model.state[ready] = STABLE
    for counter in (model.colour_errors, model.depth_errors):
        counter[ready] = 0

    is_lost = torch.zeros_like(stable)
    is_lost[is_expired] = True
    if config.on_error == "release":
        model.state[wrong] = UNSTABLE
        model.clock.begin(wrong)
        for counter in (
            model.confidence,
            model.frames_in_view,
            model.colour_errors,
            model.depth_errors,
        ):
            counter[wrong] = 0
    else:
        is_lost[wrong] = True

    is_oversized = torch.zeros_like(stable)
    if config.max_radius_factor is not None and len(model):
        radius = model.radius_m
        for kind in (model.is_stable, ~model.is_stable):
            # NaN without rows; no radius is above NaN
            mean = sum_rows(torch.where(kind, radius, 0.0)) / kind.sum()
            is_oversized |= kind & (radius > config.max_radius_factor * mean)
        is_oversized &= ~is_lost
    if bool((is_lost | is_oversized).any()):
        model.keep(~(is_lost | is_oversized))
    n_oversized = int(is_oversized.count_nonzero())
    return Transitions(
        stabilised=len(ready), released=len(wrong), expired=len(is_expired), oversized=n_oversized
    )


@piece
def next_states(
    stable: Bool[Tensor, " N"],
    confidence: Int[Tensor, " N"],
    errors: Int[Tensor, " N"],
    age: Int[Tensor, " N"],
    *,
    stable_confidence: float,
    error_count: int,
    unstable_frames: int,
) -> Int[Tensor, " N"]:
    """What happens to every row at the end of a frame: STAYS, BECOMES_STABLE, BECOMES_UNSTABLE or
    DELETED.

    Args:
        stable: State of every row.
        confidence: eta: optimisation steps that changed its colour.
        errors: e: frames in which it was wrong since it became stable.
        age: Frames since it was added or last became unstable.
        stable_confidence, error_count, unstable_frames: delta_eta, delta_e, delta_t, all to be
            exceeded.

    Source: Peng et al. 2024, section 3.2, "State management".
    """
    happens = torch.full_like(age, STAYS)
    happens[~stable & (age > unstable_frames)] = DELETED
    happens[~stable & (confidence > stable_confidence)] = BECOMES_STABLE
    happens[stable & (errors > error_count)] = BECOMES_UNSTABLE
    return happens


def fuse_with_history(
    before: GaussianParams,
    after: GaussianParams,
    confidence_before: Int[Tensor, " N"],
    confidence_after: Int[Tensor, " N"],
    *,
    history_max_weight: float = 1.0,
) -> GaussianParams:
    """G = w G_before + (1 - w) G_after,  w = min(history_max_weight, eta_before / eta_after).

    Quaternions are interpolated on the sphere; opacity does not change.

    Args:
        before, after: Parameters before and after the optimisation of a window.
        confidence_before, confidence_after: Confidence counts eta.
        history_max_weight: Largest weight of the values before (paper 1, released code 0.5).

    Differentiable: yes, through torch.

    Source: Peng et al. 2024, Eq. 9, whose w_curr is 1 - w. (The released code uses the weight of
    the first row for all parameters except centre and quaternion.)
    """
    w = _weight_of_history(confidence_before, confidence_after, history_max_weight).to(after.xyz_W)

    def history_mean(name: str) -> Tensor:
        rows = [getattr(params, name).flatten(1) for params in (before, after)]
        mean = fuse(
            *rows, confidence_before, confidence_after, history_max_weight=history_max_weight
        )
        return mean.view_as(getattr(after, name))

    return GaussianParams(
        xyz_W=history_mean("xyz_W"),
        log_scale=history_mean("log_scale"),
        quat=quaternion.slerp(after.quat, before.quat, w),
        opacity_logit=after.opacity_logit,
        sh=history_mean("sh"),
    )


@piece
def fuse(
    before: Float[Tensor, "N K"],
    after: Float[Tensor, "N K"],
    confidence_before: Int[Tensor, " N"],
    confidence_after: Int[Tensor, " N"],
    *,
    history_max_weight: float = 1.0,
) -> Float[Tensor, "N K"]:
    """Values after a window, fused with those before it; arguments as for ``fuse_with_history``.

    Differentiable: yes, through torch. Source: Peng et al. 2024, Eq. 9.
    """
    w = _weight_of_history(confidence_before, confidence_after, history_max_weight).to(after)[
        :, None
    ]
    return w * before + (1 - w) * after  # RTG-SLAM Eq. 9


def _weight_of_history(
    before: Int[Tensor, " N"], after: Int[Tensor, " N"], largest: float
) -> Float[Tensor, " N"]:
    return (before / after.clamp_min(1)).clamp(max=largest)
