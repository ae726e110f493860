"""When a surfel becomes stable or unstable, or is removed (Peng et al. 2024, section 3.2, "State
management")."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import piece
from ..config import StateConfig
from ..geometry import project, se3, sum_rows
from ..types import ALL_ROWS, Camera, MapRows
from .surfels import STABLE, UNSTABLE, SurfelModel


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
    age = model.frames_in_view if config.age == "in_view" else model.clock.count - model.clock.birth
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
