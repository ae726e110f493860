"""The pose of one view from its picture, by the flow that a motion would cause: for maps that have no gradient."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_whole
from ..types import Camera, RenderOutput
from .align_view import pose_step, pose_system
from .fit_pose import PoseFit

STEPS = 8
"""Pictures drawn."""
SIGMA = 0.05
"""Metres and radians: how far the pose may be from the given one, as a standard deviation, and the longest step."""


def fit_pose_by_flow(
    draw: Callable[[Camera, Tensor], RenderOutput],
    camera: Camera,
    rgb: Float[Tensor, "H W 3"],
    T_WC: Float[Tensor, "4 4"],
    *,
    steps: int = STEPS,
) -> PoseFit:
    """Move a camera until the map's picture fits the one that was taken, without any gradient of the map.

    ``fit_pose`` needs the gradient of every part of the picture; a surface seen by rays has none. Here the colours
    and depths of the picture say how it moves (``pose_system``). Of all poses tried, the best is returned.

    Args:
        draw: Renders the map; its picture, depth and alpha are used.
        camera: Of the view.
        rgb: The picture that was taken, 0..1. [H, W, 3]
        T_WC: Its pose so far.
        steps: Pictures drawn.

    Raises:
        ValueError: ``steps`` is no whole number of at least 1.

    Differentiable: no.
    """
    check_whole("steps", steps, 1)
    sigma = torch.full((6,), SIGMA, dtype=torch.float64)
    here, tried = T_WC, list[tuple[float, Tensor]]()
    for _ in range(steps):
        output = draw(camera, here)
        tried.append((float((output.rgb - rgb).square().mean()), here))
        if tried[-1][0] > 1.5 * tried[0][0]:
            break
        here = pose_step(pose_system(output, rgb, camera), here, T_WC, sigma)
    mse, best = min(tried, key=lambda trial: trial[0])
    return PoseFit(T_WC=best, mse_before=tried[0][0], mse_after=mse)
