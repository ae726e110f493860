"""When a Gaussian becomes stable or unstable, or is removed (Peng et al. 2024, section 3.2, "State management")."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import observed, piece
from ..config import StateConfig
from ..geometry import project, se3, sum_rows
from ..types import Camera
from .surfels import STABLE, UNSTABLE, SurfelModel

STAYS, BECOMES_STABLE, BECOMES_UNSTABLE, DELETED = 0, 1, 2, 3
"""What happens to a row at the end of a frame."""


@dataclass(frozen=True, kw_only=True)
class Transitions:
    """How many rows changed state in one frame."""

    stabilised: int
    """Unstable rows that became stable."""
    released: int
    """Stable rows with too many errors, which became unstable again (or were deleted, ``on_error="delete"``)."""
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
    """Add 1 to the error count e_i of every stable row that is wrong in this frame, for colour and for depth.

    A row is wrong if the largest error among its pixels is above the threshold.

    Args:
        model: The map; its counters change.
        colour_error: Mean absolute difference over R, G, B, 0 where it should not count. [H, W]
        colour_index: Row that dominates each pixel's colour, or -1. [H, W]
        depth_error_m: Measured minus rendered depth, 0 where it should not count, metres. [H, W]
        depth_index: Row that each pixel's ray hits, or -1. [H, W]
        config: Thresholds.
    """
    depth_error = depth_error_m if config.depth_error_sides == "in_front" else depth_error_m.abs()
    for counter, error, index, limit in (
        (model.colour_errors, colour_error, colour_index, config.colour_error),
        (model.depth_errors, depth_error, depth_index, config.depth_error_m),
    ):
        wrong = torch.zeros_like(counter, dtype=torch.bool)
        wrong[index[(index >= 0) & (error > limit)].long()] = True
        counter += wrong & model.is_stable


def count_views(model: SurfelModel, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> None:
    """Add 1 to ``frames_in_view`` of every row whose centre is in front of the camera and in the image, even if hidden.

    Args:
        model: The map; its counter changes.
        camera: Intrinsics and size.
        T_WC: Camera-to-world pose.
    """
    xyz_C = se3.apply(se3.inverse(T_WC), model.params.xyz_W)
    u, v = project(camera, xyz_C).unbind(-1)
    model.frames_in_view.add_((xyz_C[:, 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height))


@observed
def change_states(model: SurfelModel, config: StateConfig) -> Transitions:
    """Unstable -> stable by confidence, stable -> unstable by errors, and removal of bad rows.

    eta_i > delta_eta                unstable becomes stable
    e_i > delta_e                    stable becomes unstable; its confidence and its age start again
    k - t_i > delta_t                unstable is removed; ``config.age`` says which frames count
    r_i > max_radius_factor mean(r)  removed, stable or not (released code; not in the paper)
    """
    stable = model.is_stable
    age = model.frames_in_view if config.age == "in_view" else model.step_count - model.birth_step
    errors = model.depth_errors
    if config.on_error == "release":
        errors = errors.maximum(model.colour_errors)
    happens = next_states(
        stable, model.confidence, errors, age,
        stable_confidence=config.stable_confidence, error_count=config.error_count,
        unstable_frames=config.unstable_frames,
    )  # fmt: skip
    ready, wrong, expired = (happens == what for what in (BECOMES_STABLE, BECOMES_UNSTABLE, DELETED))
    model.state[ready] = STABLE
    for counter in (model.colour_errors, model.depth_errors):
        counter[ready] = 0

    gone = torch.zeros_like(stable)
    if config.on_error == "release":
        model.state[wrong] = UNSTABLE
        model.confidence[wrong] = 0
        model.birth_step[wrong] = model.step_count
        model.frames_in_view[wrong] = 0
        model.colour_errors[wrong] = 0
        model.depth_errors[wrong] = 0
    else:
        gone = wrong

    oversized = torch.zeros_like(expired)
    if config.max_radius_factor is not None and len(model):
        radius = model.radius_m
        for rows in (model.is_stable, ~model.is_stable):
            mean = sum_rows(torch.where(rows, radius, 0.0)) / rows.sum()  # NaN without rows; no radius is above NaN
            oversized |= rows & (radius > config.max_radius_factor * mean)
    changed = (ready, wrong, expired, oversized & ~expired & ~gone)
    gone = gone | expired | oversized
    stabilised, released, n_expired, n_oversized, n_gone = torch.stack([*changed, gone]).sum(dim=1).tolist()
    if n_gone:
        model.keep(~gone)
    return Transitions(stabilised=stabilised, released=released, expired=n_expired, oversized=n_oversized)


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
    """What happens to every row at the end of a frame: STAYS, BECOMES_STABLE, BECOMES_UNSTABLE or DELETED.

    Args:
        stable: State of every row.
        confidence: eta: optimisation steps that changed its colour.
        errors: e: frames in which it was wrong since it became stable.
        age: Frames since it was added or last became unstable.
        stable_confidence, error_count, unstable_frames: delta_eta, delta_e, delta_t, all to be exceeded.

    Source: Peng et al. 2024, section 3.2, "State management".
    """
    happens = torch.full_like(age, STAYS)
    happens[~stable & (age > unstable_frames)] = DELETED
    happens[~stable & (confidence > stable_confidence)] = BECOMES_STABLE
    happens[stable & (errors > error_count)] = BECOMES_UNSTABLE
    return happens
