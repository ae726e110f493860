"""The properties that every seeding rule has: each function tests one in a scene, and raises
``AssertionError`` where it does not hold."""

import dataclasses
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..code_keys.key import loaded_values
from ..geometry import se3
from ..types import Frame, Seeds
from .apply import apply_rule
from .context import SeedContext
from .input_guard import ChangedInputError, context_tensors
from .map_rule import MapRule, Option, SeedingRule, is_map_rule
from .memory import copy_memory, equal_memories
from .options import option_values
from .rule import rule_choices, rule_options


@dataclass(frozen=True)
class RuleWithOptions:
    """A rule with options."""

    rule: SeedingRule
    options: dict[str, Option]

    def seeds(
        self,
        ctx: SeedContext,
        changes: Mapping[str, Option] | None = None,
    ) -> Seeds:
        return apply_rule(self.rule, ctx, {**self.options, **(changes or {})})

    def instance(self) -> MapRule:
        """An instance of a class."""
        values: Any = option_values(self.rule, self.options)
        assert is_map_rule(self.rule)
        return self.rule(**values)


def with_extra(ctx: SeedContext, extra: Callable[[Frame], Mapping[str, Any]] | None) -> SeedContext:
    """The same context whose frame has further images, those that ``extra`` gives for it; without
    ``extra`` the context itself."""
    if extra is None:
        return ctx
    return dataclasses.replace(
        ctx, frame=dataclasses.replace(ctx.frame, extra=dict(extra(ctx.frame)))
    )


def fresh_context(ctx: SeedContext, seed: int = 0, **changes: Any) -> SeedContext:
    """The same context with nothing cached, a copy of its memory, and its generator at the
    start."""
    generator = torch.Generator().manual_seed(seed)
    return dataclasses.replace(ctx, generator=generator, memory=copy_memory(ctx.memory), **changes)


def run_unchanged(subject: RuleWithOptions, ctx: SeedContext, where: str) -> Seeds:
    """Run once; frame and maps must be bit for bit the same afterwards."""
    fresh = fresh_context(ctx)
    _ = fresh.frame.rgb
    with refuse_changes(fresh, where):
        return subject.seeds(fresh)


@contextmanager
def refuse_changes(ctx: SeedContext, where: str) -> Iterator[None]:
    """Raise ``AssertionError`` at the end of the block if anything that a rule can read was changed
    in place."""
    copies = [(name, tensor, tensor.clone()) for name, tensor in context_tensors(ctx)]
    try:
        yield
    except ChangedInputError as e:
        raise AssertionError(
            f"{where}: it changed {e.what} in place; work on a copy (x.clone())"
        ) from None
    for name, tensor, original in copies:
        if not torch.equal(tensor, original):
            raise AssertionError(f"{where}: it changed {name} in place; work on a copy (x.clone())")


def check_nothing_kept(rule: SeedingRule, code_hash: str, where: str) -> None:
    """The rule stores nothing new after all these runs, except in the memory of a context."""
    if loaded_values(rule) != code_hash:
        raise AssertionError(
            f"{where}: it keeps something from one frame to the next (a global, a variable around "
            "it, an attribute); its seeds may depend on the context only: keep it in ctx.memory"
        )


def check_randomness(
    subject: RuleWithOptions, ctx: SeedContext, first: Seeds, where: str
) -> dict[str, Any]:
    """Runs on equal inputs give equal seeds, and leave equal memories. Returns the memory
    afterwards."""
    memories = []
    for seed in (1, 2):
        fresh = fresh_context(ctx)
        with other_generators(seed):
            state = torch.get_rng_state()
            second = subject.seeds(fresh)
            uses_global = not torch.equal(torch.get_rng_state(), state)
        if uses_global:
            raise AssertionError(
                f"{where}: it drew random numbers from torch's global generator; draw from the "
                "context only: torch.rand(..., generator=ctx.generator)"
            )
        if not equal_memories(vars(first), vars(second)):
            raise AssertionError(
                f"{where}: two runs on the same input gave different seeds; a rule may depend on "
                "the context only, and draw from ctx.generator only"
            )
        memories.append(fresh.memory)
    if not equal_memories(*memories):
        raise AssertionError(
            f"{where}: two runs on the same input left different values in its memory; they may "
            "depend on the context and on the memory only"
        )
    return memories[0]


def check_in_front(seeds: Seeds, frame: Frame, where: str) -> None:
    """All seeds lie in front of the camera."""
    z = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)[:, 2]
    n_behind = int((z <= 0).sum())
    if n_behind:
        raise AssertionError(
            f"{where}: {n_behind} of {len(seeds)} seeds lie behind the camera; xyz_W is in the "
            "world frame, T_WC applied"
        )


def check_missing_depth(subject: RuleWithOptions, ctx: SeedContext, where: str) -> None:
    """A frame without depth gets no seeds."""
    blind = dataclasses.replace(ctx.frame, depth_m=torch.zeros_like(ctx.frame.depth_m))
    n_seeds = len(subject.seeds(fresh_context(ctx, frame=blind)))
    if n_seeds:
        raise AssertionError(
            f"{where}: the frame has no depth, yet it gave {n_seeds} seeds; there is no surface to "
            "seed"
        )


def check_every_option(
    subject: RuleWithOptions, ctx: SeedContext, first: Seeds, where: str
) -> None:
    """Passing the defaults by name changes nothing; every switch and every choice works."""
    defaults = rule_options(subject.rule) | subject.options
    if not equal_memories(vars(first), vars(subject.seeds(fresh_context(ctx), defaults))):
        raise AssertionError(
            f"{where}: passing its own defaults {defaults} by name gave other seeds than leaving "
            "them out"
        )
    for options in _other_options(defaults, rule_choices(subject.rule)):
        seeds = subject.seeds(fresh_context(ctx), options)
        check_in_front(seeds, ctx.frame, f"{where}, with {options}")


def _other_options(
    defaults: dict[str, Option], choices: dict[str, tuple[str, ...]]
) -> Iterable[dict[str, Option]]:
    for name, default in defaults.items():
        if isinstance(default, bool):
            yield {name: not default}
        for word in choices.get(name, ()):
            yield {name: word}


@contextmanager
def other_generators(seed: int) -> Iterator[None]:
    """Set the global random generators to other states inside the block, and restore them after
    it."""
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    torch.default_generator.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
    try:
        yield
    finally:
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])
