"""The optimisation of an RTG-SLAM map while it is scanned: over the last frames and over keyframes
(Peng et al. 2024, section 3.2, Eq. 7-9)."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..gaussians import fuse_with_history
from ..optim import Keyframe, TrainingView, ViewStep
from ..render import render_forward, rows_in_view
from ..render.near_plane import near_plane_m
from ..types import Frame, GaussianParams
from .after_steps import StepStatistics
from .surfel_optimiser import SurfelOptimiser

WORST_SHARE = 0.4
"""Share of a keyframe's tiles, or pixels, that have a loss in the optimisation over keyframes,
those with the largest colour errors."""
TILE_PX = 16
"""Side of a tile, pixels. Tiles of this size without a loss take no time to draw."""

KEYFRAMES_LR_FACTOR = 0.1
"""Learning rates of the optimisation over keyframes as a multiple of the window's; centres do not
move."""

MASKED_BELOW = 0.8
"""If more of the rows in view are unstable, they touch nearly all pixels; finding these then saves
no time."""


@dataclass(frozen=True, eq=False)
class DiscStep:
    """A gradient step on copies of rows, for the rule of the mapper."""

    source: Frame | Keyframe
    """What was compared with."""
    target_rgb: Float[Tensor, "H W 3"]
    """Its image."""
    view_step: ViewStep
    statistics: StepStatistics


def optimise_window(mapper: Any) -> list[float]:
    """Optimise the unstable Gaussians against the last frames, then fuse them with the old values
    (Eq. 7-9). Returns the losses before the steps.

    Args:
        mapper: The ``RTGSLAM``.
    """
    config = mapper.config.window
    model = mapper.gaussians
    is_trained = ~model.is_stable if config.only_unstable else torch.ones_like(model.is_stable)
    is_in_view = _rows_in_views(mapper, mapper.window)
    if not (is_trained & is_in_view).any():
        return []
    optimiser = SurfelOptimiser(
        model,
        is_trained,
        config,
        mapper.config.discs,
        is_in_view=is_in_view,
        all_in_view=mapper.config.all_in_view,
        training=mapper.training,
        near_m=near_plane_m(mapper.config),
    )
    old_params = GaussianParams(
        **{name: value.clone() for name, value in vars(optimiser.trained_params).items()}
    )
    masks = config.only_unstable and optimiser.n < MASKED_BELOW * int(is_in_view.sum())
    newest_from = config.iterations / 2 if config.draw == "newest_half" else math.inf
    sources = list(mapper.window)
    near_m = near_plane_m(mapper.config)

    def view_of(source: Frame) -> TrainingView:
        pixels = _covered_pixels(old_params, source, near_m) if masks else None
        return TrainingView.of(source, pixels)

    losses, last_step = _take_steps(
        mapper, optimiser, sources, view_of, config.iterations, newest_from
    )
    old_confidence = model.confidence[optimiser.rows]
    confidence = old_confidence + optimiser.colour_steps
    fused_params = fuse_with_history(
        old_params,
        optimiser.trained_params,
        old_confidence,
        confidence,
        history_max_weight=config.history_max_weight,
    )  # RTG-SLAM Eq. 9
    optimiser.write_back(fused_params)
    model.confidence[optimiser.rows] = confidence
    edit_after(mapper, last_step)
    return torch.stack(losses).tolist() if losses else []


def optimise_keyframes(mapper: Any) -> int:
    """Optimise over the latest and some random keyframes, where their colour errors are largest
    (``KeyframeConfig.worst``). Returns the number of gradient steps.

    Args:
        mapper: The ``RTGSLAM``.
    """
    config = mapper.config.keyframes
    model = mapper.gaussians
    keyframes = _drawn_keyframes(mapper)
    rows = model.is_stable if config.rows == "stable" else torch.ones_like(model.is_stable)
    is_in_view = _rows_in_views(mapper, keyframes)
    if not (rows & is_in_view).any():
        return 0
    optimiser = SurfelOptimiser(
        model,
        rows,
        mapper.config.window,
        mapper.config.discs,
        is_drawn=rows,
        is_in_view=is_in_view,
        lr_factor=KEYFRAMES_LR_FACTOR,
        move_centres=False,
        all_in_view=mapper.config.all_in_view,
        training=mapper.training,
        near_m=near_plane_m(mapper.config),
    )
    _, last_step = _take_steps(
        mapper, optimiser, keyframes, partial(_worst_pixels, mapper), config.iterations
    )
    optimiser.write_back()
    edit_after(mapper, last_step)
    return config.iterations


def _covered_pixels(
    params: GaussianParams, view: Frame | Keyframe, near_m: float
) -> Bool[Tensor, "H W"]:
    """Pixels of a view that some of the rows cover, even if other rows of the map hide them."""
    output, _ = render_forward(params, view.camera, view.T_WC, with_indices=False, near_m=near_m)
    return output.alpha > 0


def step_on(
    mapper: Any, optimiser: SurfelOptimiser, source: Frame | Keyframe, view: TrainingView
) -> DiscStep:
    """One step on copies of rows.

    Args:
        mapper: The ``RTGSLAM``.
        optimiser: Has the copies.
        source: The frame or keyframe of the view.
        view: What to compare with.
    """
    rows = optimiser.drawn_rows
    statistics = mapper.after_steps.watch(mapper.gaussians, view, len(rows))
    view_step = optimiser.step(view, statistics.outputs)
    statistics = mapper.after_steps.add_up(mapper.gaussians, statistics, view.camera, rows)
    return DiscStep(source, view.rgb, view_step, statistics)


def edit_after(mapper: Any, step: DiscStep | None) -> None:
    """Let the rule edit the map after the rows of its last step, if any, were written back."""
    if step is not None:
        mapper.after_steps.edit(
            mapper, step.statistics, step.source, step.view_step, step.target_rgb
        )


def _take_steps(
    mapper: Any,
    optimiser: SurfelOptimiser,
    sources: list[Any],
    view_of: Callable[[Any], TrainingView],
    n: int,
    newest_from: float = math.inf,
) -> tuple[list[Tensor], DiscStep | None]:
    """``n`` gradient steps on sources drawn at random, from step ``newest_from`` on only on the
    newest. ``view_of`` makes the view of a source at its first step. Returns the losses before the
    steps, and the last step."""
    losses = []
    step = None
    views: dict[int, TrainingView] = {}
    for k in range(n):
        mapper.guard.may_stop()
        i = len(sources) - 1
        if k < newest_from:
            i = int(torch.randint(len(sources), (), generator=mapper.random.keyframes))
        if i not in views:
            views[i] = view_of(sources[i])
        step = step_on(mapper, optimiser, sources[i], views[i])
        losses.append(step.view_step.loss)
    optimiser.take_missed_steps()
    mapper.lost.stepped(optimiser.trained_params)
    return losses, step


def _drawn_keyframes(mapper: Any) -> list[Keyframe]:
    """Some earlier keyframes at random, and the latest ones."""
    config = mapper.config.keyframes
    n = len(mapper.keyframes)
    latest = list(range(max(0, n - config.latest), n))
    order = torch.randperm(n - len(latest), generator=mapper.random.keyframes)
    earlier = order[: config.random].tolist()
    return [mapper.keyframes[i].to(mapper.device) for i in earlier + latest]


def _rows_in_views(mapper: Any, views: Iterable[Frame | Keyframe]) -> Bool[Tensor, " N"]:
    """Rows that any of the views may show."""
    params = mapper.gaussians.params
    is_in_view = torch.zeros_like(mapper.gaussians.is_stable)
    near_m = near_plane_m(mapper.config)
    for view in views:
        depth_m = None if mapper.config.all_in_view else view.depth_m
        rows = mapper.parts.boxes.rows(params, view.camera, view.T_WC, depth_m)
        is_in_view[rows] |= rows_in_view(params[rows], view.camera, view.T_WC, near_m)
    return is_in_view


def _worst_pixels(mapper: Any, keyframe: Keyframe) -> TrainingView:
    """The view of a keyframe with the pixels that have a loss: its worst tiles, or pixels."""
    rgb = keyframe.rgb
    surface = mapper.surface(keyframe.camera, keyframe.T_WC, keyframe.farthest_m)
    error = (surface.rgb - rgb).abs().mean(dim=-1)
    if mapper.config.keyframes.worst == "tiles":
        pixels = worst_tiles(error)
    else:
        pixels = error >= error.flatten().quantile(1 - WORST_SHARE)
    return TrainingView.of(keyframe, pixels, rgb)


def worst_tiles(
    error: Float[Tensor, "H W"], share: float = WORST_SHARE, tile_px: int = TILE_PX
) -> Bool[Tensor, "H W"]:
    """Pixels of the tiles with the largest mean errors.

    Args:
        error: Error of each pixel. [H, W]
        share: Of the tiles, rounded to at least one.
        tile_px: Side of a tile; those at the right and lower border may be smaller.
    """
    height, width = error.shape
    tiles = torch.nn.functional.avg_pool2d(error[None], tile_px, ceil_mode=True)[0]
    n = max(1, round(share * tiles.numel()))
    is_worst = torch.zeros_like(tiles, dtype=torch.bool).flatten()
    is_worst[tiles.flatten().topk(n).indices] = True
    by_row = is_worst.view(tiles.shape).repeat_interleave(tile_px, dim=0)
    return by_row.repeat_interleave(tile_px, dim=1)[:height, :width].contiguous()
