"""Seeding rules by name: ``@seeding_rule`` registers a function; a mapper takes its name or the function itself.

A rule is a function ``(ctx: SeedContext, *, number=default, ...) -> Seeds``. It proposes the Gaussians that are created
from one frame. It changes none of its inputs, and draws random numbers only from ``ctx.generator``.
"""

import inspect
import math
import typing
import weakref
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from ..checks import check_finite, check_name, check_shape
from ..errors import shown
from ..plausible import MAX_DISTANCE_M
from ..types import Seeds
from .context import SeedContext
from .unchanged_inputs import ChangedInputError, Versions

SeedingRule = Callable[..., Seeds]
F = TypeVar("F", bound=SeedingRule)
Option = bool | int | float | str

_RULES: dict[str, SeedingRule] = {}
_KNOWN_OPTIONS: weakref.WeakKeyDictionary[SeedingRule, dict[str, inspect.Parameter]] = weakref.WeakKeyDictionary()
"""Rule -> its options, since reading a signature takes longer than many a step of a rule."""
_COLUMNS = {"xyz_W": ("N", 3), "rgb": ("N", 3), "scale_m": ("N", 3), "quat": ("N", 4), "opacity": ("N",), "tag": ("N",)}


def seeding_rule(rule: F) -> F:
    """Register ``rule`` under its own name and return it unchanged; a rule of that name is replaced.

    Raises:
        TypeError: the signature is not ``(ctx, *, name=default, ...)`` with defaults that are numbers, True/False, or a
            word of a ``Literal["...", ...]``.
    """
    if not callable(rule):
        raise TypeError(f"@seeding_rule decorates a function, got {type(rule).__name__}; write it without parentheses")
    if not rule_name(rule).isidentifier():
        raise TypeError(f"a seeding rule is registered by its name, and {rule_name(rule)!r} is not a name: use def")
    _options_of(rule)
    _RULES[rule_name(rule)] = rule
    return rule


def get_rule(rule: str | SeedingRule) -> SeedingRule:
    """The function registered under a name; a function is returned unchanged after its signature was checked.

    Raises:
        KeyError: no rule of that name; the message lists the registered ones. TypeError: bad signature.
    """
    if isinstance(rule, str):
        check_name("seeding rule", rule, _RULES)
        return _RULES[rule]
    if not callable(rule):
        raise TypeError(f"a seeding rule is a name or a function, got {type(rule).__name__}")
    _options_of(rule)
    return rule


def registered() -> dict[str, SeedingRule]:
    """Name -> function of every registered rule, in order of registration (a copy)."""
    return dict(_RULES)


def rule_name(rule: str | SeedingRule) -> str:
    """Name of a rule in messages and reports."""
    return rule if isinstance(rule, str) else getattr(rule, "__name__", type(rule).__name__)


def rule_options(rule: str | SeedingRule) -> dict[str, Option]:
    """Option name -> default; sliders and check boxes are made from it."""
    return {name: parameter.default for name, parameter in _options_of(get_rule(rule)).items()}


def rule_choices(rule: str | SeedingRule) -> dict[str, tuple[str, ...]]:
    """Option name -> allowed words, for the options that are a word; drop-down lists are made from it."""
    options = _options_of(get_rule(rule))
    return {name: typing.get_args(p.annotation) for name, p in options.items() if isinstance(p.default, str)}


def apply_rule(
    rule: str | SeedingRule, ctx: SeedContext, options: Mapping[str, Option] | None = None, one_per_voxel: bool = False
) -> Seeds:
    """Run a rule on one frame and check what it returns.

    Args:
        rule: Name or function.
        ctx: What the rule may look at.
        options: Keyword arguments for the rule, in place of its defaults.
        one_per_voxel: Afterwards keep at most one seed per voxel, and none in voxels that hold a Gaussian.

    Returns:
        The new Gaussians, on the frame's device.

    Raises:
        KeyError: no such rule. TypeError: unknown option, wrong type of option or of result.
        ValueError: a column of wrong shape, NaN, scale <= 0, opacity outside (0, 1), colour outside 0..1, or an
            implausibly large position or scale. ChangedInputError: the rule changed the frame or the map in place.
    """
    function = get_rule(rule)
    options = dict(options or {})
    check_options(function, options)
    versions = Versions(ctx)
    seeds = function(ctx, **options)
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


def _options_of(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    """The keyword options of a rule, or a sentence about what is wrong with its signature."""
    try:
        options = _KNOWN_OPTIONS.get(rule)
    except TypeError:  # an object that cannot be a key
        return _read_options(rule)
    if options is None:
        options = _KNOWN_OPTIONS[rule] = _read_options(rule)
    return options


def _read_options(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    name = rule_name(rule)
    wanted = f"a seeding rule is written  def {name}(ctx, *, number=default, ...) -> Seeds"
    parameters = list(_signature(rule).parameters.values())
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    if not parameters or parameters[0].kind not in positional:
        raise TypeError(f"{wanted}; this one does not take the context as its first argument")
    for p in parameters[1:]:
        if p.kind is not inspect.Parameter.KEYWORD_ONLY:
            raise TypeError(f"{wanted}; {str(p)!r} must be keyword-only: put it after a bare *, with a default")
        if p.default is inspect.Parameter.empty:
            raise TypeError(f"{wanted}; option {p.name!r} has no default, which sliders and check_rule need")
        if not isinstance(p.default, bool | int | float | str):
            raise TypeError(
                f"{wanted}; the default of option {p.name!r} must be a number, True/False or a word, got {p.default!r}"
            )
        if isinstance(p.default, str) and p.default not in typing.get_args(p.annotation):
            raise TypeError(
                f"{wanted}; option {p.name!r} is a word, so annotate the allowed words: "
                f'{p.name}: Literal["{p.default}", ...] = "{p.default}"'
            )
    return {p.name: p for p in parameters[1:]}


def _signature(rule: SeedingRule) -> inspect.Signature:
    try:
        return inspect.signature(rule, eval_str=True)
    except (NameError, AttributeError, SyntaxError):  # an annotation written as text that cannot be evaluated here
        return inspect.signature(rule)


def check_options(rule: SeedingRule, options: dict[str, Any]) -> None:
    """Raise ``TypeError`` for an option that the rule does not have, or a value of another type than its default's."""
    known = _options_of(rule)
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise TypeError(f"seeding rule {rule_name(rule)!r} has no options {shown(unknown)}; known: {sorted(known)}")
    for name, value in options.items():
        default = known[name].default
        if isinstance(default, str):
            fits, wanted = value in typing.get_args(known[name].annotation), typing.get_args(known[name].annotation)
        elif isinstance(default, bool):
            fits, wanted = isinstance(value, bool), "True or False"
        else:
            fits, wanted = isinstance(value, int | float) and not isinstance(value, bool), "a number"
        if not fits:
            raise TypeError(f"seeding rule {rule_name(rule)!r}: option {name!r} must be {wanted}, got {shown(value)}")


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
