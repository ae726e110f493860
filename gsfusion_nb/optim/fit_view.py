"""The pose of one view from its picture, while the map stays.

``fit_pose`` follows the gradient of the picture. ``fit_pose_by_flow`` is for maps that have no
gradient; it takes Gauss-Newton steps by the flow that a motion would cause (``pose_system``).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_whole
from ..geometry import se3
from ..render import pose_vjp, render_forward, render_vjp
from ..render.constants import NEAR_PLANE_M
from ..types import Camera, GaussianParams, RenderOutput
from .pose_system import pose_step, pose_system

EVALUATIONS = 20
"""Pictures drawn, one for each trial pose; a line search that has begun may add a few."""

UNIT = 0.01
"""Metres and radians: the motions that are sought are about this large, so numbers in this unit are
about 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseFit:
    """The fitted pose of a view."""

    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose with the smallest error of all that were tried, the given one
    included."""
    mse_before: float
    """Mean squared error of the picture at the given pose, colours 0..1."""
    mse_after: float
    """At ``T_WC``; at most ``mse_before``."""


def fit_pose(
    params: GaussianParams,
    camera: Camera,
    rgb: Float[Tensor, "H W 3"],
    T_WC: Float[Tensor, "4 4"],
    *,
    evaluations: int = EVALUATIONS,
    near_m: float = NEAR_PLANE_M,
) -> PoseFit:
    """Move a camera until the map's picture fits the one that was taken: the mean squared error, by
    L-BFGS on a twist.

    It corrects poses that are wrong by some millimetres and tenths of a degree, as a tracker's are.
    It finds no view whose pose is unknown: the picture must nearly fit, because a Gaussian's
    gradient reaches only as far as it does.

    Args:
        params: The map.
        camera: Of the view.
        rgb: The picture that was taken, 0..1. [H, W, 3]
        T_WC: Its pose so far.
        evaluations: Pictures drawn with their gradients before the search ends; a few more end a
            line search.
        near_m: Nearer Gaussians are not drawn, metres.

    Raises:
        ValueError: ``evaluations`` is no whole number of at least 1.

    Differentiable: no. Source: MonoGS and SplaTAM (Matsuki et al. 2024, Keetha et al. 2024) track
    by minimising such an error over the pose, with Adam; L-BFGS needs fewer pictures.
    """
    check_whole("evaluations", evaluations, 1)
    T_start = T_WC.to(params.xyz_W)
    x = T_start.new_zeros(6, requires_grad=True)
    attempts: list[tuple[float, Tensor]] = []

    def error() -> float:
        T_WC = T_start @ se3.exp(UNIT * x)
        T_try = T_WC.detach()
        output, record = render_forward(params, camera, T_try, with_indices=False, near_m=near_m)
        difference = output.rgb - rgb
        mse = float(difference.square().mean())
        attempts.append((mse, T_try))
        v_xi = pose_vjp(params, render_vjp(record, 2 * difference / difference.numel()), T_try)
        with torch.enable_grad():
            # zero: its derivative leads from the twist at ``here`` to x
            twist = se3.log(se3.inverse(T_try) @ T_WC)
        (gradient,) = torch.autograd.grad(twist, x, v_xi)
        scale = max(attempts[0][0], 1e-12)
        x.grad = gradient / scale
        return mse / scale

    solver = torch.optim.LBFGS(
        [x],
        max_iter=evaluations,
        max_eval=evaluations,
        tolerance_change=1e-4,
        line_search_fn="strong_wolfe",
    )
    solver.step(error)
    mse, best = min(attempts, key=lambda trial: trial[0])
    return PoseFit(T_WC=best, mse_before=attempts[0][0], mse_after=mse)


STEPS = 8
"""Pictures drawn."""

SIGMA = 0.05
"""Metres and radians: how far the pose may be from the given one, as a standard deviation, and the
longest step."""


def fit_pose_by_flow(
    draw: Callable[[Camera, Tensor], RenderOutput],
    camera: Camera,
    rgb: Float[Tensor, "H W 3"],
    T_WC: Float[Tensor, "4 4"],
    *,
    steps: int = STEPS,
) -> PoseFit:
    """Move a camera until the map's picture fits the one that was taken, without any gradient of
    the map.

    ``fit_pose`` needs the gradient of every part of the picture; a surface seen by rays has none.
    Here the colours and depths of the picture say how it moves (``pose_system``). Of all poses
    tried, the best is returned.

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
    T_try = T_WC
    attempts = list[tuple[float, Tensor]]()
    for _ in range(steps):
        output = draw(camera, T_try)
        attempts.append((float((output.rgb - rgb).square().mean()), T_try))
        if attempts[-1][0] > 1.5 * attempts[0][0]:
            break
        T_try = pose_step(pose_system(output, rgb, camera), T_try, T_WC, sigma)
    mse, best = min(attempts, key=lambda trial: trial[0])
    return PoseFit(T_WC=best, mse_before=attempts[0][0], mse_after=mse)
