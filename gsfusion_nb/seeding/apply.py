"""Running a seeding rule: it leaves its inputs unchanged, keeps only what can be saved, and returns valid seeds."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

import torch
from jaxtyping import Int
from torch import Tensor

from ..backends import observed
from ..checks import check_finite, check_shape
from ..operands import MAX_DISTANCE_M
from ..types import Seeds, rgb_of_bytes
from .context import SeedContext
from .memory import check_memory
from .rule import Option, SeedingRule, get_rule, is_map_rule, option_values, rule_name

_COLUMNS = {"xyz_W": ("N", 3), "rgb": ("N", 3), "scale_m": ("N", 3), "quat": ("N", 4), "opacity": ("N",), "tag": ("N",)}


@observed
def apply_rule(
    rule: str | SeedingRule, ctx: SeedContext, options: Mapping[str, Option] | None = None, one_per_voxel: bool = False
) -> Seeds:
    """Run a rule on one frame and check what it returns.

    Args:
        rule: Name, function or class.
        ctx: What the rule may look at, and its memory.
        options: Values of the rule's options, in place of its defaults.
        one_per_voxel: Afterwards keep at most one seed per voxel, and none in voxels that hold a Gaussian.

    Returns:
        The new Gaussians, on the frame's device.

    Raises:
        KeyError: no such rule. TypeError: unknown option, wrong type of option or of result, or something in the
            rule's memory that cannot be saved.
        ValueError: a column of wrong shape, NaN, scale <= 0, opacity outside (0, 1), colour outside 0..1, or an
            implausibly large position or scale. ChangedInputError: the rule changed the frame or the map in place.
    """
    found = get_rule(rule)
    values: Any = option_values(found, options or {})
    versions = Versions(ctx)
    if is_map_rule(found):
        seeds = found(**values).seeds(ctx, ctx.memory)
    else:
        seeds = cast(Callable[..., Seeds], found)(ctx, **values)
    check_memory(rule_name(rule), ctx.memory)
    if changed := versions.changed():
        raise ChangedInputError(rule_name(rule), changed)
    try:
        _check_seeds(seeds, ctx)
    except (TypeError, ValueError) as error:
        raise type(error)(f"seeding rule {rule_name(rule)!r} returned invalid seeds: {error}") from None
    if not one_per_voxel:
        return seeds
    taken = None if ctx.gaussians is None else ctx.voxel_index(ctx.gaussians.params.xyz_W)
    return keep_one_per_voxel(seeds, ctx.voxel_index(seeds.xyz_W), taken)


def keep_one_per_voxel(seeds: Seeds, voxel: Int[Tensor, "N 3"], taken: Int[Tensor, "M 3"] | None = None) -> Seeds:
    """Of the seeds that share a voxel, keep the one with the largest standard deviation; of equal ones the first.

    The largest one best covers the area of the seeds that are dropped. GSFusion IV-C.1 says that a voxel contains at
    most one Gaussian, but not which one.

    Args:
        seeds: Proposed Gaussians, N rows.
        voxel: Integer voxel coordinates of each. [N, 3]
        taken: Voxels that hold a Gaussian of the map; no seed in them is kept. [M, 3]

    Returns:
        The seeds that are kept, in their order.
    """
    if taken is not None and len(taken) and len(seeds):
        _, group = torch.unique(torch.cat([voxel, taken]), dim=0, return_inverse=True)
        free = ~torch.isin(group[: len(seeds)], group[len(seeds) :])
        seeds, voxel = seeds[free], voxel[free]
    if len(seeds) == 0:
        return seeds
    size = seeds.scale_m.amax(dim=-1)
    order = size.argsort(descending=True, stable=True)
    _, group = torch.unique(voxel[order], dim=0, return_inverse=True)
    rank = torch.arange(len(seeds), device=group.device)
    best = torch.full_like(rank, len(seeds)).scatter_reduce_(0, group, rank, "amin")
    return seeds[order[best[best < len(seeds)]].sort().values]


def _is_plausible(seeds: Seeds) -> bool:
    """Whether all values are finite and within the limits of ``_check_seeds``. A GPU is waited for once."""
    columns = [getattr(seeds, name) for name in _COLUMNS if name != "tag"]
    extremes = [extreme for column in (*columns, seeds.quat.norm(dim=-1)) for extreme in torch.aminmax(column)]
    values = torch.stack(extremes).tolist()  # those of a NaN are NaN
    xyz, rgb, scale_m, _, opacity, length = zip(values[::2], values[1::2], strict=True)
    return (
        all(map(math.isfinite, values))
        and max(-xyz[0], xyz[1]) <= MAX_DISTANCE_M
        and 0 <= rgb[0] <= rgb[1] <= 1
        and 0 < scale_m[0] <= scale_m[1] < MAX_DISTANCE_M
        and 0 < opacity[0] <= opacity[1] < 1
        and length[0] > 1e-6
    )


def _check_seeds(seeds: Any, ctx: SeedContext) -> None:
    if not isinstance(seeds, Seeds):
        hint = " (is there a return?)" if seeds is None else ""
        raise TypeError(f"expected Seeds, got {type(seeds).__name__}{hint}")
    n = len(seeds)
    for name, shape in _COLUMNS.items():
        column = getattr(seeds, name)
        check_shape(name, column, (n, *shape[1:]))
        if column.device != ctx.frame.depth_m.device:
            raise ValueError(f"{name} must be on the frame's device {ctx.frame.depth_m.device}, got {column.device}")
        if name != "tag" and not column.is_floating_point():
            raise ValueError(f"{name} must be floating point, got {column.dtype}")
    if n == 0 or _is_plausible(seeds):
        return
    length = seeds.quat.norm(dim=-1)
    far = f"{MAX_DISTANCE_M:,.0f} m"
    limits = (
        (f"xyz_W must be within {far} of the origin", seeds.xyz_W, seeds.xyz_W.abs() <= MAX_DISTANCE_M),
        (f"scale_m must be below {far}", seeds.scale_m, seeds.scale_m < MAX_DISTANCE_M),
        ("scale_m must be > 0", seeds.scale_m, seeds.scale_m > 0),
        ("opacity must lie strictly between 0 and 1", seeds.opacity, (seeds.opacity > 0) & (seeds.opacity < 1)),
        ("rgb must lie in 0..1", seeds.rgb, (seeds.rgb >= 0) & (seeds.rgb <= 1)),
        ("quat must not be zero", length, length > 1e-6),
    )
    for name in _COLUMNS:
        if name != "tag":
            check_finite(name, getattr(seeds, name))
    for rule, values, ok in limits:
        if not ok.all():
            bad = values[~ok]
            row = int((~ok).nonzero()[0, 0])
            raise ValueError(
                f"{rule}, got {len(bad)} other values, from {float(bad.min()):g} to {float(bad.max()):g}, the first of "
                f"them in row {row}"
            )


class ChangedInputError(RuntimeError):
    """A seeding rule changed the frame or the map in place.

    Args:
        rule: Name of the rule.
        what: Which tensors.
    """

    def __init__(self, rule: str, what: list[str]):
        super().__init__(
            f"seeding rule {rule!r} changed {' and '.join(what)} in place; a rule must leave its inputs unchanged: "
            "work on a copy (x.clone())"
        )
        self.what = " and ".join(what)
        self.changed_map = any(not name.startswith("frame.") for name in what)


class Versions:
    """torch's version counters of a context's tensors at one time.

    Writes through ``numpy()`` are not counted; ``check_rule`` finds those.
    """

    def __init__(self, context: SeedContext):
        self._frame = context.frame
        self._tensors = [(name, tensor, _version(tensor)) for name, tensor in context_tensors(context)]

    def changed(self) -> list[str]:
        """Names of the tensors that have been changed since."""
        names = [name for name, tensor, version in self._tensors if _version(tensor) != version]
        made = vars(self._frame).get("rgb")  # floats that the rule was the first to ask for
        if made is not None and all(made is not tensor for _, tensor, _ in self._tensors):
            names += ["frame.rgb"] * (_version(made) != _version(rgb_of_bytes(self._frame.colour[:1, :1])))
        return names


def context_tensors(context: SeedContext) -> Iterator[tuple[str, Tensor]]:
    """Name and tensor of everything that a rule can read in a context: frame, Gaussians, keyframes, poses, volume."""
    frame = context.frame
    yield "frame.rgb_u8" if frame.is_8_bit else "frame.rgb", frame.colour
    yield from ((f"frame.{name}", getattr(frame, name)) for name in ("depth_m", "T_WC"))
    if (rgb := vars(frame).get("rgb")) is not None and rgb is not frame.colour:
        yield "frame.rgb", rgb
    yield from ((f"frame.extra[{name!r}]", image) for name, image in frame.extra.items())
    if context.gaussians is not None:
        params = context.gaussians.params
        yield from ((f"map.{f.name}", getattr(params, f.name)) for f in dataclasses.fields(params))
        for name in ("tag", "state"):
            if isinstance(column := getattr(context.gaussians, name, None), Tensor):
                yield f"map.{name}", column
    for i, keyframe in enumerate(context.keyframes):
        for name in ("rgb_u8", "depth_m", "T_WC"):
            if isinstance(value := getattr(keyframe, name, None), Tensor):
                yield f"keyframes[{i}].{name}", value
    yield from (("past_T_WC", T_WC) for T_WC in context.past_T_WC[-1:])  # a mapper's poses share one counter
    for name in ("D", "W", "rgb"):
        if isinstance(values := getattr(context.volume, name, None), Tensor):
            yield f"volume.{name}", values


def _version(tensor: Tensor) -> int:
    return 0 if tensor.is_inference() else tensor._version
