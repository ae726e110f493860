"""Hidden inputs of the exercises, drawn from a seed: on each, a submission must agree with the reference.

They are the same for all students of a class, and in no file that a student has.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...geometry import depth_to_points, se3
from ...types import Camera

F64 = torch.float64


def whole(g: torch.Generator, low: int, high: int) -> int:
    """A whole number from low to high, both included."""
    return int(torch.randint(low, high + 1, (), generator=g))


def number(g: torch.Generator, low: float | int, high: float | int) -> float:
    """A number between two."""
    return low + (high - low) * float(torch.rand((), generator=g, dtype=F64))


def numbers(
    g: torch.Generator, low: float | int, high: float | int, *shape: int, dtype: torch.dtype = torch.float32
) -> Tensor:
    """A tensor of numbers between two."""
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=dtype)


def normal(g: torch.Generator, *shape: int) -> Tensor:
    """A float64 tensor of normally distributed numbers."""
    return torch.randn(*shape, generator=g, dtype=F64)


def pose(g: torch.Generator, dtype: torch.dtype = F64, size: float | int = 1.0) -> Tensor:
    """A pose in general position."""
    return se3.exp(size * numbers(g, -0.8, 0.8, 6, dtype=F64)).to(dtype)


def camera(g: torch.Generator, width: int = 40, height: int = 30) -> Camera:
    """A camera with two focal lengths, and its principal point off the middle."""
    fx, fy = number(g, 0.8 * width, 1.2 * width), number(g, 0.8 * width, 1.2 * width)
    cx, cy = number(g, 0.45 * width, 0.55 * width), number(g, 0.45 * height, 0.55 * height)
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _psnr(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 3, 9), whole(g, 3, 9)
    return numbers(g, 0, 1, h, w, 3, dtype=F64), numbers(g, 0, 1, h, w, 3, dtype=F64)


def _exam_frames(g: torch.Generator) -> tuple[Any, ...]:
    every = whole(g, 2, 9)
    return whole(g, 1, 90), every, whole(g, 0, every - 1)


def _normals_of_points(g: torch.Generator) -> tuple[Any, ...]:
    shape = camera(g, 9, 7)
    return (depth_to_points(shape, 2 + 0.2 * numbers(g, 0, 1, 7, 9)),)


def _signed_distance(g: torch.Generator) -> tuple[Any, ...]:
    depth = numbers(g, 0.5, 3, 40) * (numbers(g, 0, 1, 40) > 0.2)
    return depth, (depth + numbers(g, -0.5, 0.5, 40)).clamp_min(0.05), number(g, 0.05, 0.3)


def _running_average(g: torch.Generator) -> tuple[Any, ...]:
    W = torch.randint(0, 12, (40,), generator=g).float()
    return numbers(g, -1, 1, 40), W, numbers(g, -1, 1, 40), float(whole(g, 11, 14))


def _zero_crossing(g: torch.Generator) -> tuple[Any, ...]:
    sign = 1 - 2 * torch.randint(0, 2, (9,), generator=g).float()
    return numbers(g, -1, 1, 9, 3), numbers(g, -1, 1, 9, 3), sign * numbers(g, 0.1, 1, 9), -sign * numbers(g, 0.1, 1, 9)


def _picture(g: torch.Generator, height: int, width: int) -> Tensor:
    """Half of it calm, half noise."""
    noise = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    calm = noise // 64 + 100
    return torch.where(torch.arange(width)[None, :, None] < whole(g, 3, width - 3), calm, noise)


def _cell_to_gaussian(g: torch.Generator) -> tuple[Any, ...]:
    cell = (whole(g, 0, 25), whole(g, 0, 18), whole(g, 2, 12), whole(g, 2, 10))
    return camera(g), cell, numbers(g, 1, 3, 30, 40), pose(g, torch.float32)


def _covariance(g: torch.Generator, n: int = 3) -> Tensor:
    L = 0.2 * normal(g, n, n)
    return L @ L.T + 1e-3 * torch.eye(n, dtype=F64)


def _covariance_2d(g: torch.Generator) -> tuple[Any, ...]:
    xyz = torch.cat([numbers(g, -0.5, 0.5, 2, dtype=F64), numbers(g, 1, 3, 1, dtype=F64)])
    return xyz, _covariance(g), number(g, 50, 120), number(g, 50, 120)


def _composite_pixel(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 12)
    return numbers(g, 0, 0.99, n), numbers(g, 0, 1, n, 3)


def _conic(g: torch.Generator, dtype: torch.dtype) -> Tensor:
    return torch.tensor([number(g, 0.2, 0.5), number(g, -0.15, 0.15), number(g, 0.2, 0.5)], dtype=dtype)


def _row(g: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A pose of a camera, and centre, log_scale and quat of a Gaussian in front of it."""
    T_CW = pose(g)
    ahead = torch.cat([numbers(g, -0.5, 0.5, 2, dtype=F64), numbers(g, 1.5, 3, 1, dtype=F64)])
    quat = torch.nn.functional.normalize(normal(g, 4), dim=0)
    return T_CW, se3.apply(se3.inverse(T_CW), ahead), numbers(g, 0.02, 0.3, 3, dtype=F64).log(), quat


def _slope(g: torch.Generator) -> tuple[Any, ...]:
    a, b = normal(g, 4), normal(g, 4)
    return lambda p: (a * p).sum() + (b * p * p).sum() + (a * p).sin().sum(), normal(g, 4), 1e-4


def _l1_gradient(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 2, 6), whole(g, 2, 6)
    return numbers(g, 0, 1, h, w, 3), numbers(g, 0, 1, h, w, 3)


def _pinhole_vjp(g: torch.Generator) -> tuple[Any, ...]:
    xyz = torch.cat([normal(g, 2), numbers(g, 1, 3, 1, dtype=F64)])
    return xyz, number(g, 50, 120), number(g, 50, 120), normal(g, 2)


def _inverse_vjp(g: torch.Generator) -> tuple[Any, ...]:
    v_Q = normal(g, 2, 2)
    return _covariance(g, 2).inverse() / 10, v_Q + v_Q.T


def _blend_vjp(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 9)
    return numbers(g, 0, 0.9, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64), normal(g, 3)


def _adam(g: torch.Generator) -> tuple[Any, ...]:
    v = numbers(g, 0, 1, 6, 2, dtype=F64)
    rest = (number(g, 1e-3, 0.1), number(g, 0.8, 0.95), number(g, 0.99, 0.999), number(g, 1e-8, 0.1))
    return normal(g, 6, 2), normal(g, 6, 2), normal(g, 6, 2), v, whole(g, 1, 30), *rest


def _splat_alpha_vjp(g: torch.Generator) -> tuple[Any, ...]:
    opacity = torch.tensor(number(g, 0.2, 0.95), dtype=F64)
    return 2 * normal(g, 30), 2 * normal(g, 30), _conic(g, F64), opacity, normal(g, 30)


def _weights_over(g: torch.Generator) -> tuple[Any, ...]:
    n, surface = whole(g, 1, 12), whole(g, 0, 3) > 0
    D_s = numbers(g, 1.5, 2.5, 1, dtype=F64)[0] * surface
    return numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 1, 3, n, dtype=F64), D_s, number(g, 0.05, 0.4)


def _blend_over(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 0, 12)
    return numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64), numbers(g, 0, 1, 3, dtype=F64)


def _blend_over_vjp(g: torch.Generator) -> tuple[Any, ...]:
    n = whole(g, 1, 12)
    w, c = numbers(g, 0, 0.99, n, dtype=F64), numbers(g, 0, 1, n, 3, dtype=F64)
    C = (numbers(g, 0, 1, 3, dtype=F64) + w @ c) / (1 + w.sum())
    return w, c, C, normal(g, 3)


def _adding_masks(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 2, 6), whole(g, 2, 6)
    D = numbers(g, 1, 3, h, w) * (numbers(g, 0, 1, h, w) > 0.2)
    C = numbers(g, 0, 1, h, w, 3)
    off = numbers(g, -0.25, 0.25, h, w, 1)
    return numbers(g, 0, 1, h, w), D + numbers(g, -0.3, 0.3, h, w), D, (C + off).clamp(0, 1), C


def _disc_hit(g: torch.Generator) -> tuple[Any, ...]:
    r = torch.cat([numbers(g, -0.5, 0.5, 2), torch.ones(1)])
    n = torch.nn.functional.normalize(normal(g, 3), dim=0).float()
    return r, torch.cat([numbers(g, -0.5, 0.5, 2), numbers(g, 1, 3, 1)]), n


def _fuse(g: torch.Generator) -> tuple[Any, ...]:
    before = torch.randint(0, 40, (8,), generator=g)
    return numbers(g, -1, 1, 8, 3), numbers(g, -1, 1, 8, 3), before, before + torch.randint(0, 30, (8,), generator=g)


def _predict(g: torch.Generator) -> tuple[Any, ...]:
    before = pose(g)
    return before, pose(g, size=0.2) @ before


def _spread_correction(g: torch.Generator) -> tuple[Any, ...]:
    poses = torch.stack([pose(g) for _ in range(whole(g, 3, 7))])
    return poses, pose(g, size=0.3) @ poses[-1]


def _relative_error(g: torch.Generator) -> tuple[Any, ...]:
    T_i, T_j = pose(g), pose(g)
    return T_i, T_j, se3.inverse(T_i) @ T_j @ pose(g, size=1e-4)  # exact Jacobians differ by about half of e


def _graph_step(g: torch.Generator) -> tuple[Any, ...]:
    n, edges = whole(g, 3, 5), whole(g, 5, 7)
    j = torch.cat([torch.arange(1, n), torch.randint(1, n, (edges - n + 1,), generator=g)])
    i = (j - 1) * (torch.rand(edges, generator=g) < 0.7)
    J_i, J_j = 0.3 * normal(g, edges, 6, 6), torch.eye(6, dtype=F64) + 0.1 * normal(g, edges, 6, 6)
    L = torch.eye(6, dtype=F64) + 0.1 * normal(g, edges, 6, 6)
    return torch.stack([pose(g) for _ in range(n)]), i, j, 0.05 * normal(g, edges, 6), J_i, J_j, L @ L.mT


def _pose_shift(g: torch.Generator) -> tuple[Any, ...]:
    curve, k = numbers(g, 0, 1, 46, dtype=F64), whole(g, -3, 3)
    return 30 * curve[3:43], curve[3 - k : 43 - k].clone(), 3


def _tell_apart(g: torch.Generator) -> tuple[Any, ...]:
    a, T_ba, kind = numbers(g, -1, 1, 200, 3, dtype=F64), pose(g), whole(g, 0, 2)
    b = se3.apply(T_ba, a) + 0.005 * normal(g, 200, 3)
    wide = torch.tensor([1.3, 1.3, 1.0], dtype=F64)
    told = T_ba if kind != 1 else se3.exp(torch.tensor([0.3, 0.0, 0.0, 0.0, 0.2, 0.0], dtype=F64)) @ T_ba
    return (a * wide, b * wide, told, 0.005) if kind == 2 else (a, b, told, 0.005)


def _depth_factor(g: torch.Generator) -> tuple[Any, ...]:
    a_m, T = numbers(g, -1, 1, 50, 3, dtype=F64), pose(g)
    factor = number(g, 0.5, 5)
    return a_m / factor, se3.apply(T, a_m) / factor, T[:3, :3], T[:3, 3]


def _overall_speedup(g: torch.Generator) -> tuple[Any, ...]:
    names = ("tsdf", "quadtree", "seeding", "optimise")
    return {name: number(g, 0.01, 0.3) for name in names}, names[whole(g, 0, 3)], number(g, 1, 30)


def _average_loop(g: torch.Generator) -> tuple[Any, ...]:
    d = numbers(g, -2, 3, 40).numpy()
    d[numbers(g, 0, 1, 40).numpy() < 0.1] = np.nan
    W = torch.randint(1, 6, (40,), generator=g).float().numpy()
    return numbers(g, -1, 1, 40).numpy(), W, d, 5.0


DRAWS: dict[str, Callable[[torch.Generator], tuple[Any, ...]]] = {
    "first_seen": lambda g: (torch.randint(0, 4, (30,), generator=g).float(), numbers(g, -1.0, 3.0, 30).clamp_min(0)),
    "psnr": _psnr,
    "exam_frames": _exam_frames,
    "project_points": lambda g: (camera(g), torch.cat([numbers(g, -1, 1, 12, 2), numbers(g, 0.5, 4, 12, 1)], dim=1)),
    "lift_pixels": lambda g: (camera(g), numbers(g, 0, 30, 12, 2), numbers(g, 0.5, 4, 12)),
    "invert_pose": lambda g: (pose(g, torch.float32),),
    "normals_of_points": _normals_of_points,
    "halve_intrinsics": lambda g: (number(g, 300, 700), number(g, 300, 700), number(g, 200, 400), number(g, 150, 300)),
    "signed_distance": _signed_distance,
    "running_average": _running_average,
    "block_of": lambda g: (numbers(g, -3, 3, 30, 3), number(g, 0.01, 0.06)),
    "morton_code": lambda g: (whole(g, 0, 1023), whole(g, 0, 1023), whole(g, 0, 1023)),
    "zero_crossing": _zero_crossing,
    "contrast": lambda g: (_picture(g, whole(g, 4, 9), whole(g, 7, 12)), whole(g, 10_000, 300_000)),
    "split_cell": lambda g: (whole(g, 0, 50), whole(g, 0, 50), whole(g, 2, 41), whole(g, 2, 41)),
    "quadtree_leaves": lambda g: (
        _picture(g, whole(g, 12, 24), whole(g, 12, 24)),
        number(g, 0.001, 0.05),
        whole(g, 1, 2),
    ),
    "cell_to_gaussian": _cell_to_gaussian,
    "covariance_2d": _covariance_2d,
    "composite_pixel": _composite_pixel,
    "splat_alpha": lambda g: (
        numbers(g, -3, 3, 30),
        numbers(g, -3, 3, 30),
        _conic(g, torch.float32),
        torch.tensor(number(g, 0.2, 0.95)),
    ),
    "tiles_touched": lambda g: (
        number(g, 1, 70),
        number(g, 1, 55),
        number(g, 0.5, 14),
        whole(g, 50, 70),
        whole(g, 40, 55),
        8,
    ),
    "view_colour": lambda g: (0.5 * normal(g, 4, 3).float(), 2 * normal(g, 3).float(), normal(g, 3).float()),
    "project_gaussian": lambda g: (camera(g, 80, 60), *_row(g)),
    "project_gaussian_vjp": lambda g: (camera(g, 80, 60), *_row(g), normal(g, 2), 20 * normal(g, 3), normal(g, 1)[0]),
    "slope": _slope,
    "l1_gradient": _l1_gradient,
    "pinhole_vjp": _pinhole_vjp,
    "inverse_vjp": _inverse_vjp,
    "blend_vjp": _blend_vjp,
    "adam": _adam,
    "splat_alpha_vjp": _splat_alpha_vjp,
    "weights_over": _weights_over,
    "blend_over": _blend_over,
    "blend_over_vjp": _blend_over_vjp,
    "frame_rate": lambda g: (numbers(g, 0.01, 0.5, whole(g, 2, 9)).tolist(),),
    "plan_frame": lambda g: (whole(g, 0, 100), whole(g, 0, 5), whole(g, 4, 9), whole(g, 1, 3), whole(g, 1, 4), 50),
    "adding_masks": _adding_masks,
    "disc_hit": _disc_hit,
    "next_state": lambda g: (whole(g, 0, 1) == 1, whole(g, 80, 120), whole(g, 5, 15), whole(g, 100, 140)),
    "fuse": _fuse,
    "point_to_plane": lambda g: (
        normal(g, 9, 3),
        normal(g, 9, 3),
        torch.nn.functional.normalize(normal(g, 9, 3), dim=1),
    ),
    "gauss_newton": lambda g: (pose(g), 0.05 * normal(g, 30), normal(g, 30, 6)),
    "predict": _predict,
    "spread_correction": _spread_correction,
    "relative_error": _relative_error,
    "graph_step": _graph_step,
    "pareto_rules": lambda g: (
        torch.randint(1, 9, (12,), generator=g) * 1000.0,
        torch.randint(40, 50, (12,), generator=g) / 2,
    ),
    "pose_shift": _pose_shift,
    "tell_apart": _tell_apart,
    "depth_factor": _depth_factor,
    "overall_speedup": _overall_speedup,
    "attainable_gflops": lambda g: (number(g, 0.1, 30), number(g, 50, 150), number(g, 5, 20)),
    "adam_traffic": lambda g: (whole(g, 1, 1_000_000),),
    "average_loop": _average_loop,
}
"""Exercise -> a function that draws the arguments of one call."""
