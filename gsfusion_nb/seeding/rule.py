"""Seeding rules by name: ``@seeding_rule`` registers a function or class; a mapper takes its name, or the rule itself.

A rule is a function ``(ctx: SeedContext, *, number=default, ...) -> Seeds``, or a class (``MapRule``). It proposes the
Gaussians that are created from one frame. It changes none of its inputs but ``ctx.memory``, and draws random numbers
only from ``ctx.generator``.
"""

import contextlib
import math
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Int
from torch import Tensor

from ..checks import check_finite, check_name, check_shape
from ..observing import observed
from ..plausible import MAX_DISTANCE_M
from ..types import Seeds
from .context import SeedContext
from .map_rule import MapRule
from .memory import check_memory
from .rule_signature import Option, SeedingRule, check_options, is_map_rule, options_of, rule_name
from .unchanged_inputs import ChangedInputError, Versions

F = TypeVar("F", bound=SeedingRule)

_RULES: dict[str, SeedingRule] = {}
_COLUMNS = {"xyz_W": ("N", 3), "rgb": ("N", 3), "scale_m": ("N", 3), "quat": ("N", 4), "opacity": ("N",), "tag": ("N",)}


def seeding_rule(rule: F) -> F:
    """Register ``rule`` under its own name and return it unchanged; a rule of that name is replaced.

    Raises:
        TypeError: the signature is not ``(ctx, *, name=default, ...)`` with defaults that are numbers, True/False, or a
            word of a ``Literal["...", ...]``; or the class is not as ``MapRule`` says.
    """
    if not callable(rule):
        raise TypeError(f"@seeding_rule decorates a function, got {type(rule).__name__}; write it without parentheses")
    if not rule_name(rule).isidentifier():
        raise TypeError(f"a seeding rule is registered by its name, and {rule_name(rule)!r} is not a name: use def")
    options_of(rule)
    _RULES[rule_name(rule)] = rule
    return rule


def get_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule registered under a name; a function or class is returned unchanged after its signature was checked.

    Raises:
        KeyError: no rule of that name; the message lists the registered ones. TypeError: bad signature.
    """
    if isinstance(rule, str):
        check_name("seeding rule", rule, _RULES)
        return _RULES[rule]
    if isinstance(rule, MapRule):
        raise TypeError(
            f"pass the class {type(rule).__name__} itself as the seeding rule, and its options in the settings: "
            "seeding__options={...}"
        )
    if not callable(rule):
        raise TypeError(f"a seeding rule is a name or a function, got {type(rule).__name__}")
    options_of(rule)
    return rule


def registered() -> dict[str, SeedingRule]:
    """Name -> function or class of every registered rule, in order of registration (a copy)."""
    return dict(_RULES)


@contextlib.contextmanager
def keep_registered() -> Iterator[dict[str, SeedingRule]]:
    """Context in which rules can be registered, which are forgotten at its end; gives the rules registered before."""
    before = dict(_RULES)
    try:
        yield before
    finally:
        _RULES.clear()
        _RULES.update(before)


def rule_options(rule: str | SeedingRule) -> dict[str, Option]:
    """Option name -> default; sliders and check boxes are made from it."""
    return {name: parameter.default for name, parameter in options_of(get_rule(rule)).items()}


def rule_choices(rule: str | SeedingRule) -> dict[str, tuple[str, ...]]:
    """Option name -> allowed words, for the options that are a word; drop-down lists are made from it."""
    options = options_of(get_rule(rule))
    return {name: typing.get_args(p.annotation) for name, p in options.items() if isinstance(p.default, str)}


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
    options = dict(options or {})
    check_options(found, options)
    versions = Versions(ctx)
    if is_map_rule(found):
        seeds = found(**options).seeds(ctx, ctx.memory)
    else:
        seeds = cast(Callable[..., Seeds], found)(ctx, **options)
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
