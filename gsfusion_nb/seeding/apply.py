"""Running a seeding rule: it returns valid seeds, at most one in a voxel if asked."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..backends import observed
from ..checks import check_finite, check_shape
from ..errors import ArgumentError, KindError
from ..geometry.operands import MAX_DISTANCE_M
from ..geometry.voxel_keys import voxel_keys
from ..types import Seeds
from .bound_rule import BoundRule, bound_rule
from .context import SeedContext
from .input_guard import unchanged_inputs
from .map_queries import map_params
from .map_rule import Option, SeedingRule
from .memory import check_memory
from .volume_queries import voxel_index

_COLUMNS = {
    "xyz_W": ("N", 3),
    "rgb": ("N", 3),
    "scale_m": ("N", 3),
    "quat": ("N", 4),
    "opacity": ("N",),
    "tag": ("N",),
}


@observed
def apply_rule(
    rule: str | SeedingRule | BoundRule,
    ctx: SeedContext,
    options: Mapping[str, Option] | None = None,
    one_per_voxel: bool = False,
) -> Seeds:
    """Run a rule on one frame and check what it returns.

    Args:
        rule: Name, function or class; or one that has its options already.
        ctx: What the rule may look at, and its memory.
        options: Values of the rule's options, in place of its defaults.
        one_per_voxel: Afterwards keep at most one seed per voxel, and none in voxels that hold a
            Gaussian.

    Returns:
        The new Gaussians, on the frame's device.

    Raises:
        KeyError: no such rule. TypeError: unknown option, wrong type of option or of result, or
            something in the rule's memory that cannot be saved.
        ValueError: a column of wrong shape, NaN, scale <= 0, opacity outside (0, 1), colour outside
            0..1, or an implausibly large position or scale; or the rule changed what it was given
            to read.
    """
    if not isinstance(rule, BoundRule):
        rule = bound_rule(rule, options or {})
    with unchanged_inputs(ctx, rule):
        seeds = rule.call(ctx)
    check_memory(rule.name, ctx.memory)
    try:
        _check_seeds(seeds, ctx)
    except (TypeError, ValueError) as error:
        raise type(error)(f"seeding rule {rule.name!r} returned invalid seeds: {error}") from None
    if not one_per_voxel:
        return seeds
    map_voxels = None if ctx.gaussians is None else voxel_index(ctx, map_params(ctx).xyz_W)
    return keep_one_per_voxel(seeds, voxel_index(ctx, seeds.xyz_W), map_voxels)


def keep_one_per_voxel(
    seeds: Seeds,
    voxel: Int[Tensor, "N 3"],
    map_voxels: Int[Tensor, "M 3"] | None = None,
) -> Seeds:
    """Of the seeds that share a voxel, keep the one with the largest standard deviation; of equal
    ones the first.

    The largest one best covers the area of the seeds that are dropped. GSFusion IV-C.1 says that a
    voxel contains at most one Gaussian, but not which one.

    Args:
        seeds: Proposed Gaussians, N rows.
        voxel: Integer voxel coordinates of each. [N, 3]
        map_voxels: Voxels that hold a Gaussian of the map; no seed in them is kept. [M, 3]

    Returns:
        The seeds that are kept, in their order.
    """
    if map_voxels is not None and len(map_voxels) and len(seeds):
        free = ~torch.isin(voxel_keys(voxel), voxel_keys(map_voxels))
        seeds = seeds[free]
        voxel = voxel[free]
    if len(seeds) == 0:
        return seeds
    size = seeds.scale_m.amax(dim=-1)
    order = size.argsort(descending=True, stable=True)
    _, group = voxel_keys(voxel[order]).unique(return_inverse=True)
    rank = torch.arange(len(seeds), device=group.device)
    best = torch.full_like(rank, len(seeds)).scatter_reduce_(0, group, rank, "amin")
    return seeds[order[best[best < len(seeds)]].sort().values]


def _check_seeds(seeds: Any, ctx: SeedContext) -> None:
    if not isinstance(seeds, Seeds):
        hint = " (is there a return?)" if seeds is None else ""
        raise KindError(f"expected Seeds, got {type(seeds).__name__}{hint}")
    n = len(seeds)
    for name, shape in _COLUMNS.items():
        column = getattr(seeds, name)
        check_shape(name, column, (n, *shape[1:]))
        if column.device != ctx.frame.depth_m.device:
            raise ArgumentError(
                f"{name} must be on the frame's device {ctx.frame.depth_m.device}, got "
                f"{column.device}"
            )
        if name != "tag" and not column.is_floating_point():
            raise ArgumentError(f"{name} must be floating point, got {column.dtype}")
    if n == 0:
        return
    limit = f"{MAX_DISTANCE_M:,.0f} m"
    columns = {name: getattr(seeds, name) for name in _COLUMNS if name != "tag"}
    columns["length of quat"] = seeds.quat.norm(dim=-1)
    extremes = torch.stack([x for column in columns.values() for x in torch.aminmax(column)])
    values = extremes.tolist()  # a GPU is waited for once; the extremes of a NaN are NaN
    ranges = dict(
        zip(
            columns,
            zip(values[::2], values[1::2], strict=True),
            strict=True,
        )
    )
    for name, (low, high) in ranges.items():
        if not (math.isfinite(low) and math.isfinite(high)):
            check_finite(name, columns[name])
        requirement, fits = {
            "xyz_W": (f"within {limit} of the origin", max(-low, high) <= MAX_DISTANCE_M),
            "rgb": ("in 0..1", low >= 0 and high <= 1),
            "scale_m": (f"above 0 and below {limit}", low > 0 and high < MAX_DISTANCE_M),
            "opacity": ("strictly between 0 and 1", low > 0 and high < 1),
            "length of quat": ("above 0", low > 1e-6),
        }.get(name, ("", True))
        if not fits:
            raise ArgumentError(f"{name} must be {requirement}, got {low:g} to {high:g}")
