"""Normal equations of the colours of a picture about the pose of its camera, and the step that they
give.

If the camera moves by T_WC exp(xi), a point at X in its frame moves to X - rho - omega x X, and its
image with it. To first order the picture I of a still scene then changes at each pixel by

    J xi,      J = grad I . dpi/dX [I, -hat(X)],      X = z K^-1 (u, v, 1)

with the map's own depth z. With the residual r between the map's picture and the photograph, a step
solves (sum w J^T J) xi = -sum w J^T r, the normal equations of direct image alignment. ``pose_vjp``
is the exact gradient; the sum w J^T r agrees with it where the map is smooth, and J gives the
curvature that a gradient alone does not: how far to go along each of six directions of different
units.

Source: derived here; direct alignment goes back to Lucas & Kanade 1981, with depth e.g. Kerl et al.
2013. The gradient of the picture is the mean of both pictures' (efficient second-order
minimisation, Malis 2004).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import se3
from ..render.constants import SHOWN_ALPHA
from ..types import Camera, RenderOutput

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
