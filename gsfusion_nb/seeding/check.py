"""``check_rule`` tests on small built-in scenes whether a seeding rule keeps the contract."""

import dataclasses
import pickle
import random
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..geometry import se3
from ..types import Frame, Seeds
from .check_scenes import Walk, check_contexts
from .context import SeedContext
from .fingerprint import rule_fingerprint
from .memory import copy_memory, equal_memories
from .rule import apply_rule, get_rule, rule_choices, rule_options
from .rule_signature import Option, SeedingRule, rule_name
from .unchanged_inputs import ChangedInputError, context_tensors


@dataclass(frozen=True)
class RuleCheck:
    """What ``check_rule`` found; it exists only if everything passed."""

    rule: str
    """Name of the rule."""
    passed: tuple[str, ...]
    """The properties that were tested."""
    seeds: dict[str, int]
    """Scene -> number of seeds the rule gave there."""

    def __repr__(self) -> str:
        lines = [f"seeding rule {self.rule!r} keeps the contract"]
        lines += [f"  ok  {line}" for line in self.passed]
        lines += ["  seeds  " + ", ".join(f"{name}: {n}" for name, n in self.seeds.items())]
        if not any(self.seeds.values()):
            lines += ["  note: it seeded nothing in any of these scenes"]
        return "\n".join(lines)


def check_rule(rule: str | SeedingRule, contexts: dict[str, SeedContext] | None = None) -> RuleCheck:
    """Check the contract of a seeding rule: valid seeds, in front of the camera, none without depth, repeatable, and no
    change to the frame or the map.

    It runs in single frames, and through a walk in which a map grows from its own seeds and its memory is kept. For a
    map that GSFusion optimised, see ``gsfusion_nb.runs.mapped_contexts``.

    Args:
        rule: Name, function or class; it need not be registered.
        contexts: Scenes by name, in place of the built-in ones and of the walk.

    Returns:
        A report, printed as text.

    Raises:
        AssertionError: a property does not hold; the message names rule, scene and property.
        TypeError, ValueError: wrong signature, or invalid seeds.
    """
    function, name = get_rule(rule), rule_name(rule)
    scenes = check_contexts() if contexts is None else contexts
    counts, kept = {}, rule_fingerprint(function)
    for scene, ctx in scenes.items():
        where = f"seeding rule {name!r}, scene {scene!r}"
        first = _run_unchanged(function, ctx, where)
        _check_randomness(function, ctx, first, where)
        _check_in_front(first, ctx.frame, where)
        _check_missing_depth(function, ctx, where)
        _check_every_option(function, ctx, first, where)
        _check_nothing_kept(function, kept, where)
        counts[scene] = len(first)
    if contexts is None:
        counts["walk"] = _check_walk(function, kept, f"seeding rule {name!r}, scene 'walk'")
    passed = (
        "columns of the right shape, finite, scale > 0, opacity in (0, 1), colour in 0..1",
        "changes neither the frame nor the map",
        "same input, same output; random numbers only from ctx.generator",
        "nothing kept from one frame to the next, except in ctx.memory",
        "seeds lie in front of the camera",
        "no depth, no seeds",
        f"every option is accepted: {', '.join(rule_options(function)) or '(it has none)'}",
    )
    return RuleCheck(name, passed, counts)


def _fresh(ctx: SeedContext, seed: int = 0, **changes: Any) -> SeedContext:
    """The same context with nothing cached, a copy of its memory, and its generator at the start."""
    generator = torch.Generator().manual_seed(seed)
    return dataclasses.replace(ctx, generator=generator, memory=copy_memory(ctx.memory), **changes)


def _run_unchanged(rule: SeedingRule, ctx: SeedContext, where: str) -> Seeds:
    """Run once; frame and maps must be bit for bit the same afterwards."""
    fresh = _fresh(ctx)
    watched = [(name, tensor, tensor.clone()) for name, tensor in context_tensors(fresh)]
    _ = fresh.frame.rgb
    try:
        seeds = apply_rule(rule, fresh)
    except ChangedInputError as e:
        raise AssertionError(_changed(where, e.what)) from None
    for name, tensor, before in watched:
        if not torch.equal(tensor, before):
            raise AssertionError(_changed(where, name))
    return seeds


def _changed(where: str, what: str) -> str:
    return f"{where}: it changed {what} in place; work on a copy (x.clone())"


def _check_walk(rule: SeedingRule, kept: str, where: str) -> int:
    """Several frames in which a map grows from the rule's own seeds. Returns the number of seeds."""
    total, memory = 0, {}
    walk = Walk()
    for number in range(walk.n_frames):
        here, ctx = f"{where}, frame {number}", walk.context(number, memory)
        first = _run_unchanged(rule, ctx, here)
        after = _check_randomness(rule, ctx, first, here)
        _check_in_front(first, ctx.frame, here)
        _check_nothing_kept(rule, kept, here)
        walk.grow(first)
        total, memory = total + len(first), after
    return total


def _check_nothing_kept(rule: SeedingRule, before: str, where: str) -> None:
    """The rule stores nothing new after all these runs, except in the memory of a context."""
    if rule_fingerprint(rule) != before:
        raise AssertionError(
            f"{where}: it keeps something from one frame to the next (a global, a variable around it, an attribute); "
            "its seeds may depend on the context only: keep it in ctx.memory"
        )


def _check_randomness(rule: SeedingRule, ctx: SeedContext, first: Seeds, where: str) -> dict[str, Any]:
    """Runs on equal inputs give equal seeds, and leave equal memories. Returns the memory afterwards."""
    memories = []
    for seed in (1, 2):
        fresh = _fresh(ctx)
        with _other_generators(seed):
            state = _generator_states()
            again = apply_rule(rule, fresh)
            drawn_from = [name for name, value in _generator_states().items() if value != state[name]]
        if drawn_from:
            raise AssertionError(
                f"{where}: it drew random numbers from {' and '.join(drawn_from)}; "
                "draw from the context only: torch.rand(..., generator=ctx.generator)"
            )
        if not _same(first, again):
            raise AssertionError(
                f"{where}: two runs on the same input gave different seeds; a rule may depend on the context only, "
                "and draw from ctx.generator only"
            )
        memories.append(fresh.memory)
    if not equal_memories(*memories):
        raise AssertionError(
            f"{where}: two runs on the same input left different values in its memory; they may depend on the context "
            "and on the memory only"
        )
    return memories[0]


def _check_in_front(seeds: Seeds, frame: Frame, where: str) -> None:
    z = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)[:, 2]
    behind = int((z <= 0).sum())
    if behind:
        raise AssertionError(
            f"{where}: {behind} of {len(seeds)} seeds lie behind the camera; xyz_W is in the world frame, T_WC applied"
        )


def _check_missing_depth(rule: SeedingRule, ctx: SeedContext, where: str) -> None:
    blind = dataclasses.replace(ctx.frame, depth_m=torch.zeros_like(ctx.frame.depth_m))
    found = len(apply_rule(rule, _fresh(ctx, frame=blind)))
    if found:
        raise AssertionError(f"{where}: the frame has no depth, yet it gave {found} seeds; there is no surface to seed")


def _check_every_option(rule: SeedingRule, ctx: SeedContext, first: Seeds, where: str) -> None:
    """Passing the defaults by name changes nothing; every switch and every choice works."""
    defaults = rule_options(rule)
    if not _same(first, apply_rule(rule, _fresh(ctx), defaults)):
        raise AssertionError(
            f"{where}: passing its own defaults {defaults} by name gave other seeds than leaving them out"
        )
    for options in _switched(defaults, rule_choices(rule)):
        seeds = apply_rule(rule, _fresh(ctx), options)
        _check_in_front(seeds, ctx.frame, f"{where}, with {options}")


def _switched(defaults: dict[str, Option], choices: dict[str, tuple[str, ...]]) -> Iterable[dict[str, Option]]:
    for name, default in defaults.items():
        if isinstance(default, bool):
            yield {name: not default}
        for word in choices.get(name, ()):
            yield {name: word}


def _same(a: Seeds, b: Seeds) -> bool:
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(Seeds))


_STATES: dict[str, Callable[[], Any]] = {
    "torch's global generator": lambda: torch.get_rng_state().numpy().tobytes(),
    "numpy's global generator": lambda: pickle.dumps(np.random.get_state()),  # noqa: NPY002
}
"""Not Python's ``random``, which run-time type checkers use, too; a rule that uses it gives different results."""


def _generator_states() -> dict[str, Any]:
    return {name: read() for name, read in _STATES.items()}


@contextmanager
def _other_generators(seed: int) -> Iterator[None]:
    """Set the global random generators to other states inside the block, and restore them after it."""
    before = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    torch.default_generator.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
    try:
        yield
    finally:
        torch.set_rng_state(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        random.setstate(before[2])
