"""A seeding rule thinned to a random share of its seeds."""

import functools
from dataclasses import dataclass
from typing import Any, cast

import torch

from ..seeding import SeedingRule, is_map_rule
from ..types import Seeds


def thinned(rule: SeedingRule, share: float) -> SeedingRule:
    """``rule`` with a random share of its seeds, drawn from ``ctx.generator``; options and name stay the same."""
    if is_map_rule(rule):
        base: Any = rule

        @dataclass(frozen=True, kw_only=True)
        class Thinned(base):
            def seeds(self, ctx, memory):
                return _draw(super().seeds(ctx, memory), share, ctx.generator)

        for name in ("__name__", "__qualname__", "__module__", "__doc__"):
            setattr(Thinned, name, getattr(rule, name))
        return cast(SeedingRule, Thinned)

    function: Any = rule

    @functools.wraps(function)
    def some(ctx, **options):
        return _draw(function(ctx, **options), share, ctx.generator)

    return some


def _draw(seeds: Seeds, share: float, generator: torch.Generator) -> Seeds:
    n = round(share * len(seeds))
    drawn = torch.randperm(len(seeds), generator=generator, device=generator.device)[:n]
    return seeds[drawn.sort().values.to(seeds.xyz_W.device)]
