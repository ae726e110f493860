"""Exercises of chapter 5: gradients written by hand."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..render.composite import blend_weights
from ..render.constants import ALPHA_MAX
from .exercise import Attempt, Becomes, Wrong, Yours, exercise
from .gradients import central_difference

Loss = Callable[[Tensor], Tensor]


def _slope(loss: Loss, x: Tensor, h: float) -> Tensor:
    return central_difference(lambda y: float(loss(y)), x, h)


def _one_sided(loss: Loss, x: Tensor, h: float) -> Tensor:
    value = float(loss(x))
    return torch.tensor([(float(loss(x + h * e)) - value) / h for e in torch.eye(len(x)).to(x)])


def _half_forgotten(loss: Loss, x: Tensor, h: float) -> Tensor:
    return 2 * _slope(loss, x, h)


def _moves_x(loss: Loss, x: Tensor, h: float) -> Tensor:
    gradient = torch.zeros_like(x)
    for i in range(len(x)):
        x[i] += h
        loss_above = float(loss(x))
        x[i] -= 2 * h
        gradient[i] = (loss_above - float(loss(x))) / (2 * h)
    return gradient


@exercise(
    chapter=5,
    difficulty=1,
    minutes=5,
    solution=_slope,
    hints=(
        "For each i: move x[i] up by h, then down by h, and compare the two losses.",
        "Divide by 2h, the distance between the two points.",
        "Work on x.clone(), so that the caller's x does not change.",
    ),
    wrong=(
        Wrong(_one_sided, says="a parabola has no error"),
        Wrong(_half_forgotten, says="the slope of a straight line"),
        Wrong(_moves_x, says="it does not change its inputs"),
    ),
)
def slope(attempt: Attempt) -> None:
    """Gradient of a function by central differences."""
    f64 = torch.float64
    x = torch.tensor([1.0, -2.0, 0.5], dtype=f64)
    a = torch.tensor([3.0, -1.0, 2.0], dtype=f64)
    attempt.on("the straight line 3 x0 - x1 + 2 x2")
    attempt.close(
        attempt(lambda p: a @ p, x, 1e-3), a, "the slope of a straight line is its coefficients"
    )
    attempt.on("the parabola sum x^2 with h = 0.1")
    why = "take both sides: (f(x+h) - f(x-h)) / 2h"
    attempt.close(
        attempt(lambda p: (p * p).sum(), x, 0.1),
        2 * x,
        "a parabola has no error even for large h",
        why=why,
    )
    reference = torch.stack([x[0].cos() * x[1] * x[2], x[0].sin() * x[2], x[0].sin() * x[1]])
    got = attempt.on("sin(x0) x1 x2")(
        lambda p: p[0].sin() * p[1] * p[2],
        x,
        1e-4,
    )
    attempt.close(got, reference, "every element has its own slope", tolerance=1e-6)


def _l1_gradient(rgb: Tensor, target: Tensor) -> Tensor:
    return torch.sign(rgb - target) / rgb.numel()


def _not_a_mean(rgb: Tensor, target: Tensor) -> Tensor:
    return torch.sign(rgb - target)


def _uphill(rgb: Tensor, target: Tensor) -> Tensor:
    return torch.sign(target - rgb) / rgb.numel()


def _as_l1_vjp(yours: Yours, rgb: Tensor, target: Tensor, v_loss: float = 1.0) -> Tensor:
    return v_loss * yours(rgb, target, gives={"the gradient": rgb})


@exercise(
    chapter=5,
    difficulty=1,
    minutes=4,
    solution=_l1_gradient,
    becomes=Becomes("l1_vjp", _as_l1_vjp),
    hints=(
        "The derivative of |x| is its sign.",
        "The loss is a mean over H x W x 3 values: each has the factor 1 / (H W 3).",
    ),
    wrong=(
        Wrong(_uphill, says="too bright means a positive gradient"),
        Wrong(_not_a_mean, says="the loss is a mean"),
    ),
)
def l1_gradient(attempt: Attempt) -> None:
    """Gradient of the mean absolute difference of two images."""
    dark = torch.full((2, 2, 3), 0.4)
    got = attempt.on("a picture of 2 x 2 pixels, everywhere 0.2 too bright")(dark + 0.2, dark)
    attempt.signs(got, torch.ones(2, 2, 3), "too bright means a positive gradient")
    attempt.close(
        got,
        torch.full((2, 2, 3), 1 / 12),
        "the loss is a mean over pixels and channels",
        why="2 * 2 * 3 = 12 values",
    )
    attempt.on("two equal pictures")
    attempt.close(
        attempt(dark, dark), torch.zeros(2, 2, 3), "where nothing differs the gradient is 0"
    )
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(3, 5, 3, generator=generator)
    b = torch.rand(3, 5, 3, generator=generator)
    attempt.on("random pictures of 3 x 5 pixels")
    attempt.close(attempt(a, b), _l1_gradient(a, b), "dL/drgb = sign(rgb - target) / n")


def _pinhole_vjp(xyz_C: Tensor, fx: float, fy: float, v_uv: Tensor) -> Tensor:
    x, y, z = xyz_C
    v_u, v_v = v_uv
    return torch.stack([fx / z * v_u, fy / z * v_v, -(fx * x * v_u + fy * y * v_v) / z**2])


def _depth_ignored(xyz_C: Tensor, fx: float, fy: float, v_uv: Tensor) -> Tensor:
    v = _pinhole_vjp(xyz_C, fx, fy, v_uv)
    v[2] = 0
    return v


def _forwards(xyz_C: Tensor, fx: float, fy: float, v_uv: Tensor) -> Tensor:
    x, y, z = xyz_C
    v_u, v_v = v_uv
    return torch.stack([z / fx * v_u, z / fy * v_v, -(fx * x * v_u + fy * y * v_v) / z**2])


@exercise(
    chapter=5,
    difficulty=2,
    minutes=8,
    solution=_pinhole_vjp,
    hints=(
        "v_xyz = J^T v_uv with the J of chapter 4: three numbers.",
        "x moves only u, y only v, but z moves both.",
        "du/dz = -fx x / z^2, dv/dz = -fy y / z^2.",
    ),
    wrong=(
        Wrong(_forwards, says="x moves u by fx / z"),
        Wrong(_depth_ignored, says="moving away moves u and v towards the middle: -fx x / z^2"),
    ),
)
def pinhole_vjp(attempt: Attempt) -> None:
    """Gradient of the pinhole projection: from dL/d(u, v) to dL/d(x, y, z)."""
    f64 = torch.float64
    on_axis = torch.tensor([0.0, 0.0, 2.0], dtype=f64)
    aside = torch.tensor([1.0, -0.5, 2.0], dtype=f64)
    attempt.on("a point 2 m straight ahead, dL/du = 1, fx = 100")
    got = attempt(
        on_axis,
        100.0,
        80.0,
        torch.tensor([1.0, 0.0], dtype=f64),
    )
    got = torch.as_tensor(got)
    attempt.close(got[:2], [50.0, 0.0], "x moves u by fx / z")
    attempt.close(got[2], 0.0, "straight ahead, moving along z changes nothing: x is 0")
    got = attempt.on("the same point, dL/dv = 1, fy = 80")(
        on_axis, 100.0, 80.0, torch.tensor([0.0, 1.0], dtype=f64)
    )
    attempt.close(got, [0.0, 40.0, 0.0], "y moves v by fy / z")
    attempt.on("a point at (1, -0.5, 2), dL/du = dL/dv = 1")
    got = attempt(
        aside,
        100.0,
        80.0,
        torch.tensor([1.0, 1.0], dtype=f64),
    )
    why = "u = fx x / z, differentiated by z"
    attempt.close(
        got,
        [50.0, 40.0, -25.0 + 10.0],
        "moving away moves u and v towards the middle: -fx x / z^2",
        why=why,
    )
    attempt.on("another point")
    xyz = torch.tensor([-0.7, 0.3, 1.3], dtype=f64)
    v = torch.tensor([0.4, -1.7], dtype=f64)
    attempt.close(
        attempt(xyz, 90.0, 110.0, v), _pinhole_vjp(xyz, 90.0, 110.0, v), "v_xyz = J^T v_uv"
    )


def _inverse_vjp(Q: Tensor, v_Q: Tensor) -> Tensor:
    return -Q.T @ v_Q @ Q.T


def _plus(Q: Tensor, v_Q: Tensor) -> Tensor:
    return Q.T @ v_Q @ Q.T


def _element_by_element(Q: Tensor, v_Q: Tensor) -> Tensor:
    return -Q * v_Q * Q


@exercise(
    chapter=5,
    difficulty=3,
    minutes=12,
    solution=_inverse_vjp,
    hints=(
        "Start from Q cov = I and move cov a little: dQ cov + Q dcov = 0.",
        "So dQ = -Q dcov Q. For 1 x 1 matrices that is d(1/s) = -ds / s^2.",
        "L changes by <v_Q, dQ> = -trace(v_Q^T Q dcov Q). Rearrange it until it reads <v_cov, "
        "dcov>.",
    ),
    wrong=(
        Wrong(_plus, says="a wider Gaussian has a smaller conic"),
        Wrong(_element_by_element, says="the matrix acts from both sides"),
    ),
)
def inverse_vjp(attempt: Attempt) -> None:
    """Gradient of a matrix inverse: from dL/dQ to dL/dcov, Q = cov^-1."""
    f64 = torch.float64
    eye = torch.eye(2, dtype=f64)
    got = attempt.on("cov = 2 I, so Q = I / 2, and dL/dQ = I")(0.5 * eye, eye)
    attempt.close(got, -0.25 * eye, "a wider Gaussian has a smaller conic", why="d(1/s) = -1/s^2")
    cov = torch.tensor([[2.0, 0.8], [0.8, 1.0]], dtype=f64)
    v_Q = torch.tensor([[1.0, 0.3], [0.3, -2.0]], dtype=f64)
    attempt.on("a tilted ellipse")
    reference = _inverse_vjp(cov.inverse(), v_Q)
    attempt.close(
        attempt(cov.inverse(), v_Q), reference, "the matrix acts from both sides: -Q^T v_Q Q^T"
    )
    attempt.on("the same ellipse, and a v_Q that is not symmetric")
    v_Q = torch.tensor([[1.0, 0.7], [-0.4, -2.0]], dtype=f64)
    reference = _inverse_vjp(cov.inverse(), v_Q)
    why = "entry (i, j) of v_Q belongs to entry (i, j) of Q"
    attempt.close(
        attempt(cov.inverse(), v_Q), reference, "v_Q is not transposed: -Q^T v_Q Q^T", why=why
    )


def _blend(alpha: Tensor, rgb: Tensor) -> Tensor:
    T = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha[:-1]).cumprod(0)])
    return ((alpha * T)[:, None] * rgb).sum(0)


def _blend_vjp(alpha: Tensor, rgb: Tensor, v_colour: Tensor) -> tuple[Tensor, Tensor]:
    T = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha[:-1]).cumprod(0)])
    w = alpha * T
    c_dot_v = rgb @ v_colour
    light_behind = (w * c_dot_v).flip(0).cumsum(0).flip(0) - w * c_dot_v
    return T * c_dot_v - light_behind / (1 - alpha), w[:, None] * v_colour


def _shadow_forgotten(alpha: Tensor, rgb: Tensor, v_colour: Tensor) -> tuple[Tensor, Tensor]:
    T = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha[:-1]).cumprod(0)])
    return T * (rgb @ v_colour), (alpha * T)[:, None] * v_colour


def _alpha_for_weight(alpha: Tensor, rgb: Tensor, v_colour: Tensor) -> tuple[Tensor, Tensor]:
    return _blend_vjp(alpha, rgb, v_colour)[0], alpha[:, None] * v_colour


def _as_blend_vjp(yours: Yours, alpha: Tensor, c: Tensor, v_C: Tensor) -> Any:
    """Yours for each pixel whose colour has a gradient; a loss of depth or alpha is left to the
    reference. The blending ends where the reference ends it, and a clamped alpha does not move."""
    if v_C[:, 3:].any():
        return NotImplemented
    _, w = blend_weights(alpha)
    v_alpha = torch.zeros_like(alpha)
    v_c = torch.zeros_like(c)
    rgb = c[:, :3]
    rows = {p: (w[:, p] > 0).nonzero()[:, 0] for p in v_C.any(1).nonzero()[:, 0].tolist()}
    calls = [(alpha[k, p], rgb[k], v_C[p, :3]) for p, k in rows.items()]
    gives = [{"v_alpha": a, "v_rgb": each} for a, each, _ in calls]
    for (p, k), (v_a, v_rgb) in zip(rows.items(), yours.many(calls, gives), strict=True):
        v_alpha[k, p] = v_a
        v_c[k, :3] += v_rgb
    return v_alpha.where(alpha < ALPHA_MAX, 0.0), v_c


@exercise(
    chapter=5,
    difficulty=4,
    minutes=25,
    solution=_blend_vjp,
    becomes=Becomes("blend_vjp", _as_blend_vjp),
    hints=(
        "C = sum_k w_k c_k is linear in the colours: dL/dc_k = w_k v_C, with w_k = alpha_k T_k.",
        "alpha_k brightens its own term, T_k c_k, and darkens all terms behind: each has the "
        "factor (1 - alpha_k).",
        "A term j > k is w_j = (1 - alpha_k) x something, so dw_j/dalpha_k = -w_j / (1 - alpha_k). "
        "Sum over j > k.",
        "S_k, the sum over j > k of w_j (c_j . v_C), is a reversed cumsum minus the term of k.",
    ),
    wrong=(
        Wrong(_shadow_forgotten, says="what stands behind gets darker: -S / (1 - alpha)"),
        Wrong(_alpha_for_weight, says="a colour counts with its weight"),
    ),
)
def blend_vjp(attempt: Attempt) -> None:
    """Gradient of the blending of one pixel: from dL/dC to dL/dalpha and dL/dc."""
    f64 = torch.float64
    names = ("v_alpha", "v_rgb")
    alpha = torch.tensor([0.5, 0.8], dtype=f64)
    rgb = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=f64)
    attempt.on("red 0.5 in front of green 0.8, dL/dC = (1, 0, 0)")
    v_alpha, v_rgb = attempt.unpack(
        attempt(alpha, rgb, torch.tensor([1.0, 0.0, 0.0], dtype=f64)),
        names,
    )
    attempt.close(
        v_rgb,
        [[0.5, 0.0, 0.0], [0.4, 0.0, 0.0]],
        "a colour counts with its weight",
        why="w = 0.5 and 0.5 * 0.8",
    )
    attempt.close(v_alpha, [1.0, 0.0], "more alpha adds more of the Gaussian's own colour")
    attempt.on("the same, dL/dC = (0, 1, 0)")
    v_alpha, _ = attempt.unpack(
        attempt(alpha, rgb, torch.tensor([0.0, 1.0, 0.0], dtype=f64)),
        names,
    )
    why = "the red one takes light from the green one: -S / (1 - alpha) = -0.4 / 0.5"
    attempt.close(v_alpha, [-0.8, 0.5], "what stands behind gets darker: -S / (1 - alpha)", why=why)
    generator = torch.Generator().manual_seed(2)
    alpha = 0.9 * torch.rand(9, generator=generator, dtype=f64)
    rgb = torch.rand(9, 3, generator=generator, dtype=f64)
    v = torch.randn(3, generator=generator, dtype=f64)
    v_alpha, v_rgb = attempt.unpack(attempt.on("nine random Gaussians")(alpha, rgb, v), names)
    a = alpha.clone().requires_grad_()
    c = rgb.clone().requires_grad_()
    reference = torch.autograd.grad(_blend(a, c) @ v, (a, c))
    attempt.close(v_rgb, reference[1], "v_rgb agrees with autograd")
    attempt.close(v_alpha, reference[0], "v_alpha agrees with autograd")
