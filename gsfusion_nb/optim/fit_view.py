"""The pose and the exposure of one view from its picture, while the map stays.

``fit_pose`` follows the gradient of the picture. ``fit_pose_by_flow`` is for maps that have no
gradient; it takes Gauss-Newton steps by the flow that a motion would cause. If the camera moves by
T_WC exp(xi), a point at X in its frame moves to X - rho - omega x X, and its image with it. To
first order the picture I of a still scene then changes at each pixel by

    J xi,      J = grad I . dpi/dX [I, -hat(X)],      X = z K^-1 (u, v, 1)

with the map's own depth z. With the residual r between the map's picture and the photograph, a step
solves (sum w J^T J) xi = -sum w J^T r, the normal equations of direct image alignment. ``pose_vjp``
is the exact gradient; the sum w J^T r agrees with it where the map is smooth, and J gives the
curvature that a gradient alone does not: how far to go along each of six directions of different
units.

Source: derived here; direct alignment goes back to Lucas & Kanade 1981, with depth e.g. Kerl et al.
2013. The gradient of the picture is the mean of both pictures' (efficient second-order
  minimisation, Malis 2004).

The exposure is one factor per colour channel between the map's picture and the photograph
(``fit_exposure``). A camera with auto exposure shows the same wall brighter in one picture than in
the next. An exposure multiplies the light; after the camera's gamma curve it multiplies the
colours, too, (g L)^(1/2.2) = g^(1/2.2) L^(1/2.2), until they are white. So three factors a view are
nearly all there is to know, and too few to hide an error of the map.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..checks import check_whole
from ..geometry import se3
from ..render import pose_vjp, render_forward, render_vjp
from ..render.constants import SHOWN_ALPHA
from ..types import Camera, GaussianParams, RenderOutput

SMALL_RESIDUAL = 0.02
"""The weights are those of the mean absolute error, 1 / |r|, but not larger than for this
difference of colours."""
ACROSS = 80
"""About so many pixels of a row are used, at most every second one: neighbours say nearly the
same."""
PIXELS_PER_OBSERVATION = 100.0
"""Neighbouring pixels err together: so many count as one independent observation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSystem:
    """Normal equations of a pose in the frame of the camera, translation first: the best step
    solves H xi = -g."""

    H: Float[Tensor, "6 6"]
    g: Float[Tensor, " 6"]
    error: Float[Tensor, ""]
    """Mean absolute difference of the pixels that count; 0 without any."""
    share: Float[Tensor, ""]
    """Share of the pixels that count."""


def pose_system(output: RenderOutput, target: Float[Tensor, "H W 3"], camera: Camera) -> PoseSystem:
    """The evidence of one picture about its camera's pose.

    H is in units of information (inverse variances): residuals count by their mean size, and
    ``PIXELS_PER_OBSERVATION`` pixels as one. So a prior with a standard deviation in metres and
    radians can be added.

    Args:
        output: The map's picture and depth at the pose so far.
        target: The picture that was taken, 0..1.
        camera: Of both.

    Differentiable: no.
    """
    every = max(2, camera.width // ACROSS)
    some = (slice(None, None, every), slice(None, None, every))
    r = (output.rgb - target)[some]
    alpha = output.alpha[some]
    is_shown = alpha >= SHOWN_ALPHA
    gx, gy = image_gradient((output.rgb + target) / 2, every)
    w = is_shown[..., None] / r.abs().clamp_min(SMALL_RESIDUAL)
    n = is_shown.sum().clamp_min(1)
    error = (r.abs() * is_shown[..., None]).sum() / (3 * n)
    along_u, along_v = flow_of_motion(output.depth_m[some] / alpha.clamp_min(1e-6), camera, every)
    a = along_u.view(-1, 6)
    b = along_v.view(-1, 6)

    def summed(x: Tensor) -> Tensor:
        return x.sum(-1).view(-1, 1)

    H_uv = a.T @ (summed(w * gx * gy) * b)
    H = a.T @ (summed(w * gx * gx) * a) + b.T @ (summed(w * gy * gy) * b) + H_uv + H_uv.T
    g = (a.T @ summed(w * gx * r) + b.T @ summed(w * gy * r))[:, 0]
    unit = every**2 / (error.clamp_min(SMALL_RESIDUAL) * 3 * PIXELS_PER_OBSERVATION)
    return PoseSystem(
        H=unit * H,
        g=unit * g,
        error=error,
        share=is_shown.float().mean(),
    )


def flow_of_motion(
    depth_m: Float[Tensor, "h w"], camera: Camera, every: int = 1
) -> tuple[Float[Tensor, "h w 6"], Float[Tensor, "h w 6"]]:
    """Rows of dpi/dX [I, -hat(X)] for u and for v, at every n-th pixel of every n-th row, whose
    depths are given."""
    size = depth_m.shape
    u, v = (
        torch.arange(0, n, every, device=depth_m.device) + 0.5
        for n in (camera.width, camera.height)
    )
    x = ((u - camera.cx) / camera.fx).to(depth_m).expand(size)
    y = ((v - camera.cy) / camera.fy).to(depth_m)[:, None].expand(size)
    inverse = torch.where(depth_m > 0, 1 / depth_m.clamp_min(1e-6), 0.0)
    zero = torch.zeros_like(inverse)
    along_u = torch.stack(
        [inverse, zero, -x * inverse, -x * y, 1 + x * x, -y],
        dim=-1,
    )
    along_v = torch.stack(
        [zero, inverse, -y * inverse, -1 - y * y, x * y, x],
        dim=-1,
    )
    return camera.fx * along_u, camera.fy * along_v


def image_gradient(
    rgb: Float[Tensor, "H W 3"], every: int = 1
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """Central differences along u and v, per pixel; 0 at the border. Of every n-th pixel of every
    n-th row."""
    rows = rgb[::every]
    columns = rgb[:, ::every]
    gx = torch.zeros_like(rows)
    gy = torch.zeros_like(columns)
    gx[:, 1:-1] = (rows[:, 2:] - rows[:, :-2]) / 2
    gy[1:-1] = (columns[2:] - columns[:-2]) / 2
    return gx[:, ::every], gy[::every]


def pose_step(
    system: PoseSystem,
    T_WC: Float[Tensor, "4 4"],
    T_given: Float[Tensor, "4 4"],
    sigma: Float[Tensor, " 6"],
) -> Float[Tensor, "4 4"]:
    """The pose after one step, between what the picture says and the pose that was given.

    Minimises  xi^T H xi / 2 + g xi + |(e + xi) / sigma|^2 / 2  with e = log(T_given^-1 T_WC).

    Args:
        system: Of the picture at ``T_WC``.
        T_WC: The pose so far.
        T_given: The pose of the data.
        sigma: Standard deviations of the given pose: three in metres, three in radians; no step is
            longer. [6]

    Differentiable: no.
    """
    T_here = T_WC.double().cpu()
    e = se3.log(se3.inverse(T_given.double().cpu()) @ T_here)
    weight = sigma**-2
    xi = -torch.linalg.solve(
        system.H.double().cpu() + weight.diag(),
        system.g.double().cpu() + weight * e,
    )
    xi = xi / max(1.0, float((xi.abs() / sigma).max()))
    return (T_here @ se3.exp(xi)).to(T_WC)


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
        output, record = render_forward(params, camera, T_try, with_indices=False)
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


PRIOR_PIXELS = 10.0
"""The prior at factor 1 counts as so many grey pixels."""
EVERY = 2
"""Every second pixel of every second row is used: three numbers need no more."""
WHITE = 0.98
"""Brighter pixels of the photograph may be cut off and do not count."""


def apply_exposure(
    rgb: Float[Tensor, "H W 3"],
    exposure: Float[Tensor, " 3"],
) -> Float[Tensor, "H W 3"]:
    """The map's picture as a camera with this exposure takes it. Differentiable:
    ``apply_exposure_vjp``."""
    return rgb * exposure


def apply_exposure_vjp(
    rgb: Float[Tensor, "H W 3"],
    exposure: Float[Tensor, " 3"],
    v_picture: Float[Tensor, "H W 3"],
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
    """dL/drgb = exposure v and dL/dexposure = the sum over the pixels of rgb v."""
    return exposure * v_picture, (rgb * v_picture).sum((0, 1))


def fit_exposure(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    is_shown: Bool[Tensor, "H W"],
) -> Float[Tensor, " 3"]:
    """The factors with which the map's picture r fits the photograph t best: least squares, with a
    weak prior at 1.

        g = (sum r t + p / 4) / (sum r^2 + p / 4)

    with the sums over the pixels that the map shows and that are not white.

    Args:
        rgb: The map's picture.
        target: The photograph, 0..1.
        is_shown: Pixels that the map covers.

    Differentiable: no.
    """
    some = (slice(None, None, EVERY), slice(None, None, EVERY))
    used = (is_shown[some] & (target[some].amax(-1) < WHITE))[..., None]
    r = torch.where(used, rgb[some].clamp(0, 1), 0.0)
    t = torch.where(used, target[some], 0.0)
    prior = PRIOR_PIXELS / 4 / EVERY**2
    return ((r * t).sum((0, 1)) + prior) / ((r * r).sum((0, 1)) + prior)
