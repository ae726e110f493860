"""Hidden inputs of the chapters on frames, the volume and the quadtree."""

from typing import Any

import torch
from torch import Tensor

from ....geometry import depth_to_points
from .registry import F64, camera, drawn, number, numbers, pose, whole


@drawn("first_seen")
def _first_seen(g: torch.Generator) -> tuple[Any, ...]:
    return torch.randint(0, 4, (30,), generator=g).float(), numbers(g, -1.0, 3.0, 30).clamp_min(0)


@drawn("psnr")
def _psnr(g: torch.Generator) -> tuple[Any, ...]:
    h, w = whole(g, 3, 9), whole(g, 3, 9)
    return numbers(g, 0, 1, h, w, 3, dtype=F64), numbers(g, 0, 1, h, w, 3, dtype=F64)


@drawn("exam_frames")
def _exam_frames(g: torch.Generator) -> tuple[Any, ...]:
    every = whole(g, 2, 9)
    return whole(g, 1, 90), every, whole(g, 0, every - 1)


@drawn("project_points")
def _project_points(g: torch.Generator) -> tuple[Any, ...]:
    return camera(g), torch.cat([numbers(g, -1, 1, 12, 2), numbers(g, 0.5, 4, 12, 1)], dim=1)


@drawn("lift_pixels")
def _lift_pixels(g: torch.Generator) -> tuple[Any, ...]:
    return camera(g), numbers(g, 0, 30, 12, 2), numbers(g, 0.5, 4, 12)


@drawn("invert_pose")
def _invert_pose(g: torch.Generator) -> tuple[Any, ...]:
    return (pose(g, torch.float32),)


@drawn("normals_of_points")
def _normals_of_points(g: torch.Generator) -> tuple[Any, ...]:
    shape = camera(g, 9, 7)
    return (depth_to_points(shape, 2 + 0.2 * numbers(g, 0, 1, 7, 9)),)


@drawn("halve_intrinsics")
def _halve_intrinsics(g: torch.Generator) -> tuple[Any, ...]:
    return number(g, 300, 700), number(g, 300, 700), number(g, 200, 400), number(g, 150, 300)


@drawn("signed_distance")
def _signed_distance(g: torch.Generator) -> tuple[Any, ...]:
    depth = numbers(g, 0.5, 3, 40) * (numbers(g, 0, 1, 40) > 0.2)
    return depth, (depth + numbers(g, -0.5, 0.5, 40)).clamp_min(0.05), number(g, 0.05, 0.3)


@drawn("running_average")
def _running_average(g: torch.Generator) -> tuple[Any, ...]:
    W = torch.randint(0, 12, (40,), generator=g).float()
    return numbers(g, -1, 1, 40), W, numbers(g, -1, 1, 40), float(whole(g, 11, 14))


@drawn("block_of")
def _block_of(g: torch.Generator) -> tuple[Any, ...]:
    return numbers(g, -3, 3, 30, 3), number(g, 0.01, 0.06)


@drawn("morton_code")
def _morton_code(g: torch.Generator) -> tuple[Any, ...]:
    return whole(g, 0, 1023), whole(g, 0, 1023), whole(g, 0, 1023)


@drawn("zero_crossing")
def _zero_crossing(g: torch.Generator) -> tuple[Any, ...]:
    sign = 1 - 2 * torch.randint(0, 2, (9,), generator=g).float()
    return numbers(g, -1, 1, 9, 3), numbers(g, -1, 1, 9, 3), sign * numbers(g, 0.1, 1, 9), -sign * numbers(g, 0.1, 1, 9)


def _picture(g: torch.Generator, height: int, width: int) -> Tensor:
    """Half of it calm, half noise."""
    noise = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    calm = noise // 64 + 100
    return torch.where(torch.arange(width)[None, :, None] < whole(g, 3, width - 3), calm, noise)


@drawn("contrast")
def _contrast(g: torch.Generator) -> tuple[Any, ...]:
    return _picture(g, whole(g, 4, 9), whole(g, 7, 12)), whole(g, 10_000, 300_000)


@drawn("split_cell")
def _split_cell(g: torch.Generator) -> tuple[Any, ...]:
    return whole(g, 0, 50), whole(g, 0, 50), whole(g, 2, 41), whole(g, 2, 41)


@drawn("quadtree_leaves")
def _quadtree_leaves(g: torch.Generator) -> tuple[Any, ...]:
    return _picture(g, whole(g, 12, 24), whole(g, 12, 24)), number(g, 0.001, 0.05), whole(g, 1, 2)


@drawn("cell_to_gaussian")
def _cell_to_gaussian(g: torch.Generator) -> tuple[Any, ...]:
    cell = (whole(g, 0, 25), whole(g, 0, 18), whole(g, 2, 12), whole(g, 2, 10))
    return camera(g), cell, numbers(g, 1, 3, 30, 40), pose(g, torch.float32)
