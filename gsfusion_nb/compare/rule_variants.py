"""Rules made of another rule: fewer of its seeds, and what it reads of the map written down."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import torch

from ..seeding import MapRule, SeedContext, SeedingRule, is_map_rule
from ..types import Seeds


def thinned(rule: SeedingRule, share: float) -> SeedingRule:
    """``rule`` with a random share of its seeds, drawn from ``ctx.generator``; options and name
    stay the same."""
    return variant_of(rule, lambda ctx, make: _draw(make(ctx), share, ctx.generator))


def observed(rule: SeedingRule, used: set[str]) -> SeedingRule:
    """``rule``, which adds to ``used`` what it reads of the Gaussians of the map; options and name
    stay the same.

    If that is nothing, and it does not edit the map either, then the optimisation does not change
    what it seeds.
    """
    if is_map_rule(rule) and cast(Any, rule).after_step is not MapRule.after_step:
        used.add("after_step")

    def seeds(ctx: SeedContext, make: Callable[[SeedContext], Seeds]) -> Seeds:
        return make(dataclasses.replace(ctx, gaussians=_Observed(ctx.gaussians, used)))

    return variant_of(rule, seeds)


class _Observed:
    """Gaussians of a map; the names of what is read go to ``used``."""

    def __init__(self, gaussians: Any, used: set[str]):
        self._gaussians = gaussians
        self._used = used

    def __getattr__(self, name: str) -> Any:
        self._used.add(name)
        return getattr(self._gaussians, name)

    def __len__(self) -> int:
        self._used.add("len")
        return len(self._gaussians)


def variant_of(
    rule: SeedingRule, seeds: Callable[[SeedContext, Callable[[SeedContext], Seeds]], Seeds]
) -> SeedingRule:
    """``rule`` with other seeds: ``seeds(ctx, make)``, in which ``make(ctx)`` are those of
    ``rule``."""
    if is_map_rule(rule):
        base: Any = rule

        @dataclass(frozen=True, kw_only=True)
        class Variant(base):
            def seeds(self, ctx, memory):
                make = super().seeds
                return seeds(ctx, lambda ctx: make(ctx, memory))

        for name in ("__name__", "__qualname__", "__module__", "__doc__"):
            setattr(Variant, name, getattr(rule, name))
        setattr(Variant, _ORIGINAL, rule)
        return cast(SeedingRule, Variant)

    function: Any = rule

    @functools.wraps(function)
    def variant(ctx, **options):
        return seeds(ctx, lambda ctx: function(ctx, **options))

    setattr(variant, _ORIGINAL, rule)
    return variant


_ORIGINAL = "__variant_of__"


def original(rule: SeedingRule) -> SeedingRule:
    """The rule of which ``rule`` is a variant, or itself."""
    while _ORIGINAL in getattr(rule, "__dict__", {}):
        rule = vars(rule)[_ORIGINAL]
    return rule


def _draw(seeds: Seeds, share: float, generator: torch.Generator) -> Seeds:
    n = round(share * len(seeds))
    rows = torch.randperm(len(seeds), generator=generator, device=generator.device)[:n]
    return seeds[rows.sort().values.to(seeds.xyz_W.device)]
