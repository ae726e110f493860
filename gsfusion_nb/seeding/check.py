"""``check_rule`` tests on small built-in scenes whether a seeding rule keeps the contract."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ..code_keys.key import code_key, loaded_values
from ..code_keys.values import ValueHash
from ..types import Frame
from .check_after_step import check_after_step
from .check_scenes import Walk, check_contexts
from .context import SeedContext
from .map_rule import MapRule, Option, SeedingRule, is_map_rule, rule_name
from .rule import get_rule, option_paths, rule_options
from .rule_guard import UndeclaredError, only_declared
from .rule_properties import (
    RuleWithOptions,
    check_every_option,
    check_in_front,
    check_missing_depth,
    check_nothing_kept,
    check_randomness,
    run_unchanged,
    with_extra,
)

_STEPS: tuple[tuple[int, Literal["online", "passes"]], ...] = (
    (1, "online"),
    (600, "online"),
    (3000, "passes"),
)
"""Steps after which ``after_step`` is called; published strategies act every 100 or 3,000 steps
from 500 on."""


@dataclass(frozen=True)
class RuleCheck:
    """What ``check_rule`` found; it exists only if everything passed."""

    rule: str
    """Name of the rule."""
    passed: tuple[str, ...]
    """The properties that were tested."""
    seeds: dict[str, int]
    """Scene -> number of seeds the rule gave there."""
    digest: str = ""
    """A hash of all seeds, and of the map and the memory at the end of the walk: equal in every
    process."""

    def __repr__(self) -> str:
        lines = [f"seeding rule {self.rule!r} keeps the contract"]
        lines += [f"  ok  {line}" for line in self.passed]
        lines += ["  seeds  " + ", ".join(f"{name}: {n}" for name, n in self.seeds.items())]
        if not any(self.seeds.values()):
            lines += ["  note: it seeded nothing in any of these scenes"]
        return "\n".join(lines)


def check_rule(
    rule: str | SeedingRule,
    contexts: dict[str, SeedContext] | None = None,
    *,
    extra: Callable[[Frame], Mapping[str, Any]] | None = None,
    options: Mapping[str, Option] | None = None,
) -> RuleCheck:
    """Check the contract of a seeding rule: valid seeds, in front of the camera, none without
    depth, repeatable, and no change to the frame or the map.

    It runs in single frames, and through a walk in which a map grows from its own seeds and its
    memory is kept. There ``after_step`` of a class is called, too, with random gradients, and its
    edits are made.

    Args:
        rule: Name, function or class; it need not be registered.
        contexts: Scenes by name, in place of the built-in ones and of the walk.
        extra: Gives each frame the further images that the rule reads, as for ``open_sequence``.
        options: Values of the rule's options, in place of its defaults.

    Returns:
        A report, printed as text.

    Raises:
        AssertionError: a property does not hold; the message names rule, scene and property.
        TypeError, ValueError: wrong signature, or invalid seeds.
    """
    function = get_rule(rule)
    name = rule_name(rule)
    subject = RuleWithOptions(function, dict(options or {}))
    scenes = check_contexts() if contexts is None else contexts
    try:
        with only_declared(
            name,
            [*option_paths(function, subject.options).values(), *code_key(function).files],
        ):
            counts, digest = _counts(subject, scenes, extra, with_walk=contexts is None)
    except UndeclaredError as e:
        raise AssertionError(str(e)) from None
    edits = (
        contexts is None and is_map_rule(function) and function.after_step is not MapRule.after_step
    )
    properties = (
        "columns of the right shape, finite, scale > 0, opacity in (0, 1), colour in 0..1",
        "changes neither the frame nor the map",
        "same input, same output; random numbers only from ctx.generator",
        "nothing kept from one frame to the next, except in ctx.memory",
        "seeds lie in front of the camera",
        "no depth, no seeds",
        f"every option is accepted: {', '.join(rule_options(function)) or '(it has none)'}",
        *(["after_step: possible edits, the same twice, no change of its inputs"] if edits else []),
    )
    return RuleCheck(name, properties, counts, digest)


def _counts(
    subject: RuleWithOptions,
    scenes: Mapping[str, SeedContext],
    extra: Callable[[Frame], Mapping[str, Any]] | None,
    *,
    with_walk: bool,
) -> tuple[dict[str, int], str]:
    """Check a rule in each scene. Returns the number of its seeds there, and a hash of all that it
    gave."""
    counts = {}
    all_given = ValueHash(strict=False)
    name = rule_name(subject.rule)
    code_hash = loaded_values(subject.rule)
    for scene, context in scenes.items():
        ctx = with_extra(context, extra)
        where = f"seeding rule {name!r}, scene {scene!r}"
        first = run_unchanged(subject, ctx, where)
        check_randomness(subject, ctx, first, where)
        check_in_front(first, ctx.frame, where)
        check_missing_depth(subject, ctx, where)
        check_every_option(subject, ctx, first, where)
        check_nothing_kept(subject.rule, code_hash, where)
        counts[scene] = len(first)
        all_given.add(vars(first))
    if with_walk:
        counts["walk"] = _check_walk(
            subject, code_hash, extra, f"seeding rule {name!r}, scene 'walk'", all_given
        )
    return counts, all_given.hexdigest()


def _check_walk(
    subject: RuleWithOptions,
    code_hash: str,
    extra: Any,
    where: str,
    all_given: ValueHash,
) -> int:
    """Several frames in which a map grows from the rule's own seeds; the map and the memory at the
    end are added to ``all_given``. Returns the number of seeds."""
    total = 0
    memory = {}
    rule = subject.rule
    walk = Walk()
    for number in range(walk.n_frames):
        place = f"{where}, frame {number}"
        ctx = with_extra(walk.context(number, memory), extra)
        first = run_unchanged(subject, ctx, place)
        memory_after = check_randomness(subject, ctx, first, place)
        check_in_front(first, ctx.frame, place)
        check_nothing_kept(rule, code_hash, place)
        walk.grow(first)
        if is_map_rule(rule) and rule.after_step is not MapRule.after_step:
            ctx = dataclasses.replace(ctx, memory=memory_after)
            for step, stage in _STEPS:
                memory_after = check_after_step(
                    subject.instance(), ctx, step, stage, f"{place}, after step {step} ({stage})"
                )
                ctx = dataclasses.replace(ctx, memory=memory_after)
            check_nothing_kept(rule, code_hash, place)
        total = total + len(first)
        memory = memory_after
    all_given.add((vars(walk.gaussians.params), memory))
    return total
