"""Hidden inputs of the chapters on splatting, its gradients, and blending with a surface."""

from typing import Any

import torch
from torch import Tensor

from ....geometry import se3
from .registry import F64, camera, drawn, normal, number, numbers, pose, whole


def _covariance(g: torch.Generator, n: int = 3) -> Tensor:
    L = 0.2 * normal(g, n, n)
    return L @ L.T + 1e-3 * torch.eye(n, dtype=F64)


@drawn("covariance_2d")
def _covariance_2d(g: torch.Generator) -> tuple[Any, ...]:
    xyz = torch.cat([numbers(g, -0.5, 0.5, 2, dtype=F64), numbers(g, 1, 3, 1, dtype=F64)])
    return xyz, _covariance(g), number(g, 50, 120), number(g, 50, 120)


@drawn("composite_pixel")
def _composite_pixel(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 12)
    return numbers(g, 0, 0.99, n), numbers(g, 0, 1, n, 3)


@drawn("splat_alpha")
def _splat_alpha(g: torch.Generator) -> tuple[Any, ...]:
    return numbers(g, -3, 3, 30), numbers(g, -3, 3, 30), _conic(g, torch.float32), torch.tensor(number(g, 0.2, 0.95))


def _conic(g: torch.Generator, dtype: torch.dtype) -> Tensor:
    return torch.tensor([number(g, 0.2, 0.5), number(g, -0.15, 0.15), number(g, 0.2, 0.5)], dtype=dtype)


@drawn("tiles_touched")
def _tiles_touched(g: torch.Generator) -> tuple[Any, ...]:
    return number(g, 1, 70), number(g, 1, 55), number(g, 0.5, 14), whole(g, 50, 70), whole(g, 40, 55), 8


@drawn("view_colour")
def _view_colour(g: torch.Generator) -> tuple[Any, ...]:
    return 0.5 * normal(g, 4, 3).float(), 2 * normal(g, 3).float(), normal(g, 3).float()


def _row(g: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A pose of a camera, and centre, log_scale and quat of a Gaussian in front of it."""
    T_CW = pose(g)
    ahead = torch.cat([numbers(g, -0.5, 0.5, 2, dtype=F64), numbers(g, 1.5, 3, 1, dtype=F64)])
    quat = torch.nn.functional.normalize(normal(g, 4), dim=0)
    return T_CW, se3.apply(se3.inverse(T_CW), ahead), numbers(g, 0.02, 0.3, 3, dtype=F64).log(), quat


@drawn("project_gaussian")
def _project_gaussian(g: torch.Generator) -> tuple[Any, ...]:
    return camera(g, 80, 60), *_row(g)


@drawn("project_gaussian_vjp")
def _project_gaussian_vjp(g: torch.Generator) -> tuple[Any, ...]:
    return camera(g, 80, 60), *_row(g), normal(g, 2), 20 * normal(g, 3), normal(g, 1)[0]


@drawn("slope")
def _slope(g: torch.Generator) -> tuple[Any, ...]:
    a, b = normal(g, 4), normal(g, 4)
    return lambda p: (a * p).sum() + (b * p * p).sum() + (a * p).sin().sum(), normal(g, 4), 1e-4


@drawn("l1_gradient")
def _l1_gradient(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 2, 6), whole(g, 2, 6)
    return numbers(g, 0, 1, h, w, 3), numbers(g, 0, 1, h, w, 3)


@drawn("pinhole_vjp")
def _pinhole_vjp(g: torch.Generator) -> tuple[Any, ...]:
    xyz = torch.cat([normal(g, 2), numbers(g, 1, 3, 1, dtype=F64)])
    return xyz, number(g, 50, 120), number(g, 50, 120), normal(g, 2)


@drawn("inverse_vjp")
def _inverse_vjp(g: torch.Generator) -> tuple[Any, ...]:
    v_Q = normal(g, 2, 2)
    return _covariance(g, 2).inverse() / 10, v_Q + v_Q.T


@drawn("blend_vjp")
def _blend_vjp(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 9)
    return numbers(g, 0, 0.9, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64), normal(g, 3)


@drawn("adam")
def _adam(g: torch.Generator) -> tuple[Any, ...]:
    v = numbers(g, 0, 1, 6, 2, dtype=F64)
    rest = (number(g, 1e-3, 0.1), number(g, 0.8, 0.95), number(g, 0.99, 0.999), number(g, 1e-8, 0.1))
    return normal(g, 6, 2), normal(g, 6, 2), normal(g, 6, 2), v, whole(g, 1, 30), *rest


@drawn("splat_alpha_vjp")
def _splat_alpha_vjp(g: torch.Generator) -> tuple[Any, ...]:
    opacity = torch.tensor(number(g, 0.2, 0.95), dtype=F64)
    return 2 * normal(g, 30), 2 * normal(g, 30), _conic(g, F64), opacity, normal(g, 30)


@drawn("weights_over")
def _weights_over(g: torch.Generator) -> tuple[Any, ...]:
    n, surface = whole(g, 1, 12), whole(g, 0, 3) > 0
    D_s = numbers(g, 1.5, 2.5, 1, dtype=F64)[0] * surface
    return numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 1, 3, n, dtype=F64), D_s, number(g, 0.05, 0.4)


@drawn("blend_over")
def _blend_over(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 0, 12)
    return numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64), numbers(g, 0, 1, 3, dtype=F64)


@drawn("blend_over_vjp")
def _blend_over_vjp(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 12)
    w, c = numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64)
    C = (numbers(g, 0, 1, 3, dtype=F64) + w @ c) / (1 + w.sum())
    return w, c, C, normal(g, 3)
