"""Hidden inputs of the chapters on mapping, RTG-SLAM, tracking, rules, speed and recordings."""

from typing import Any

import numpy as np
import torch

from ....geometry import se3
from .registry import F64, drawn, normal, number, numbers, pose, whole


@drawn("frame_rate")
def _frame_rate(g: torch.Generator) -> tuple[Any, ...]:
    return (numbers(g, 0.01, 0.5, whole(g, 2, 9)).tolist(),)


@drawn("plan_frame")
def _plan_frame(g: torch.Generator) -> tuple[Any, ...]:
    return whole(g, 0, 100), whole(g, 0, 5), whole(g, 4, 9), whole(g, 1, 3), whole(g, 1, 4), 50


@drawn("adding_masks")
def _adding_masks(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 2, 6), whole(g, 2, 6)
    D = numbers(g, 1, 3, h, w) * (numbers(g, 0, 1, h, w) > 0.2)
    C = numbers(g, 0, 1, h, w, 3)
    off = numbers(g, -0.25, 0.25, h, w, 1)
    return numbers(g, 0, 1, h, w), D + numbers(g, -0.3, 0.3, h, w), D, (C + off).clamp(0, 1), C


@drawn("disc_hit")
def _disc_hit(g: torch.Generator) -> tuple[Any, ...]:
    r = torch.cat([numbers(g, -0.5, 0.5, 2), torch.ones(1)])
    n = torch.nn.functional.normalize(normal(g, 3), dim=0).float()
    return r, torch.cat([numbers(g, -0.5, 0.5, 2), numbers(g, 1, 3, 1)]), n


@drawn("next_state")
def _next_state(g: torch.Generator) -> tuple[Any, ...]:
    return whole(g, 0, 1) == 1, whole(g, 80, 120), whole(g, 5, 15), whole(g, 100, 140)


@drawn("fuse")
def _fuse(g: torch.Generator) -> tuple[Any, ...]:
    before = torch.randint(0, 40, (8,), generator=g)
    return numbers(g, -1, 1, 8, 3), numbers(g, -1, 1, 8, 3), before, before + torch.randint(0, 30, (8,), generator=g)


@drawn("point_to_plane")
def _point_to_plane(g: torch.Generator) -> tuple[Any, ...]:
    return normal(g, 9, 3), normal(g, 9, 3), torch.nn.functional.normalize(normal(g, 9, 3), dim=1)


@drawn("gauss_newton")
def _gauss_newton(g: torch.Generator) -> tuple[Any, ...]:
    return pose(g), 0.05 * normal(g, 30), normal(g, 30, 6)


@drawn("predict")
def _predict(g: torch.Generator) -> tuple[Any, ...]:
    before = pose(g)
    return before, pose(g, size=0.2) @ before


@drawn("spread_correction")
def _spread_correction(g: torch.Generator) -> tuple[Any, ...]:
    poses = torch.stack([pose(g) for _ in range(whole(g, 3, 7))])
    return poses, pose(g, size=0.3) @ poses[-1]


@drawn("relative_error")
def _relative_error(g: torch.Generator) -> tuple[Any, ...]:
    T_i, T_j = pose(g), pose(g)
    return T_i, T_j, se3.inverse(T_i) @ T_j @ pose(g, size=1e-4)  # exact Jacobians differ by about half of e


@drawn("graph_step")
def _graph_step(g: torch.Generator) -> tuple[Any, ...]:
    n, edges = whole(g, 3, 5), whole(g, 5, 7)
    j = torch.cat([torch.arange(1, n), torch.randint(1, n, (edges - n + 1,), generator=g)])
    i = (j - 1) * (torch.rand(edges, generator=g) < 0.7)
    J_i, J_j = 0.3 * normal(g, edges, 6, 6), torch.eye(6, dtype=F64) + 0.1 * normal(g, edges, 6, 6)
    L = torch.eye(6, dtype=F64) + 0.1 * normal(g, edges, 6, 6)
    return torch.stack([pose(g) for _ in range(n)]), i, j, 0.05 * normal(g, edges, 6), J_i, J_j, L @ L.mT


@drawn("pareto_rules")
def _pareto_rules(g: torch.Generator) -> tuple[Any, ...]:
    return torch.randint(1, 9, (12,), generator=g) * 1000.0, torch.randint(40, 50, (12,), generator=g) / 2


@drawn("pose_shift")
def _pose_shift(g: torch.Generator) -> tuple[Any, ...]:
    curve, k = numbers(g, 0, 1, 46, dtype=F64), whole(g, -3, 3)
    return 30 * curve[3:43], curve[3 - k : 43 - k].clone(), 3


@drawn("tell_apart")
def _tell_apart(g: torch.Generator) -> tuple[Any, ...]:
    a, T_ba, kind = numbers(g, -1, 1, 200, 3, dtype=F64), pose(g), whole(g, 0, 2)
    b = se3.apply(T_ba, a) + 0.005 * normal(g, 200, 3)
    wide = torch.tensor([1.3, 1.3, 1.0], dtype=F64)
    told = T_ba if kind != 1 else se3.exp(torch.tensor([0.3, 0.0, 0.0, 0.0, 0.2, 0.0], dtype=F64)) @ T_ba
    return (a * wide, b * wide, told, 0.005) if kind == 2 else (a, b, told, 0.005)


@drawn("depth_factor")
def _depth_factor(g: torch.Generator) -> tuple[Any, ...]:
    a_m, T = numbers(g, -1, 1, 50, 3, dtype=F64), pose(g)
    factor = number(g, 0.5, 5)
    return a_m / factor, se3.apply(T, a_m) / factor, T[:3, :3], T[:3, 3]


@drawn("overall_speedup")
def _overall_speedup(g: torch.Generator) -> tuple[Any, ...]:
    names = ("tsdf", "quadtree", "seeding", "optimise")
    return {name: number(g, 0.01, 0.3) for name in names}, names[whole(g, 0, 3)], number(g, 1, 30)


@drawn("attainable_gflops")
def _attainable_gflops(g: torch.Generator) -> tuple[Any, ...]:
    return number(g, 0.1, 30), number(g, 50, 150), number(g, 5, 20)


@drawn("adam_traffic")
def _adam_traffic(g: torch.Generator) -> tuple[Any, ...]:
    return (whole(g, 1, 1_000_000),)


@drawn("average_loop")
def _average_loop(g: torch.Generator) -> tuple[Any, ...]:
    d = numbers(g, -2, 3, 40).numpy()
    d[numbers(g, 0, 1, 40).numpy() < 0.1] = np.nan
    W = torch.randint(1, 6, (40,), generator=g).float().numpy()
    return numbers(g, -1, 1, 40).numpy(), W, d, 5.0
