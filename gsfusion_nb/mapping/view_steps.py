"""A gradient step on a part of a mapper's map, and what is collected of it."""

from typing import Any

from ..large_maps import MapPart
from ..optim import Keyframe, Loss, Regulariser, Render, ViewStep, optimise_view
from ..types import Frame
from .after_steps import StepStatistics


def step_on_view(
    mapper: Any,
    view: Frame | Keyframe,
    part: MapPart,
    render: Render,
    loss: Loss,
    regulariser: Regulariser | None = None,
    *,
    writes_back: bool = True,
) -> tuple[ViewStep, StepStatistics]:
    """``optimise_view`` for a mapper, with its optimiser and the statistics for its rule.

    Args:
        mapper: The ``Mapper``.
        view: The view.
        part: What of its map the view may show.
        render, loss, regulariser: As for ``optimise_view``.
        writes_back: Whether the map gets the new values now; else after a later step on the part.
    """
    watched_step = mapper.after_steps.watch(mapper.gaussians, view, len(part.params))
    step = optimise_view(
        part,
        render,
        loss,
        mapper.row_optim,
        regulariser=regulariser,
        update=mapper.training.optimiser,
        outputs=watched_step.outputs,
    )
    mapper.lost.stepped(part.params)
    if writes_back:
        part.write_back()
    return step, mapper.after_steps.add_up(mapper.gaussians, watched_step, view.camera, part.rows)
