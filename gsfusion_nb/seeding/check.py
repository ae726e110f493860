"""``check_rule`` tests on small built-in scenes whether a seeding rule keeps the contract."""

import copy
import dataclasses
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from ..checks import shown
from ..code_keys.key import code_key, loaded_values
from ..code_keys.values import ValueHash
from ..errors import KindError
from ..gaussians import Edit
from ..geometry import se3
from ..render import footprints, render
from ..types import Frame, Seeds
from .apply import apply_rule
from .check_scenes import Walk, check_contexts
from .context import SeedContext
from .input_guard import ChangedInputError, context_tensors
from .map_rule import MapRule, Option, SeedingRule, StepStats, check_needs, is_map_rule, rule_name
from .memory import check_memory, copy_memory, equal_memories
from .options import option_values
from .points import add_up
from .rule import get_rule, option_paths, rule_choices, rule_options
from .rule_guard import UndeclaredError, only_declared

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
    subject = _Tested(function, dict(options or {}))
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


@dataclass(frozen=True)
class _Tested:
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


def _counts(
    subject: _Tested,
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
        ctx = _with_extra(context, extra)
        where = f"seeding rule {name!r}, scene {scene!r}"
        first = _run_unchanged(subject, ctx, where)
        _check_randomness(subject, ctx, first, where)
        _check_in_front(first, ctx.frame, where)
        _check_missing_depth(subject, ctx, where)
        _check_every_option(subject, ctx, first, where)
        _check_nothing_kept(subject.rule, code_hash, where)
        counts[scene] = len(first)
        all_given.add(vars(first))
    if with_walk:
        counts["walk"] = _check_walk(
            subject, code_hash, extra, f"seeding rule {name!r}, scene 'walk'", all_given
        )
    return counts, all_given.hexdigest()


def _with_extra(
    ctx: SeedContext, extra: Callable[[Frame], Mapping[str, Any]] | None
) -> SeedContext:
    if extra is None:
        return ctx
    return dataclasses.replace(
        ctx, frame=dataclasses.replace(ctx.frame, extra=dict(extra(ctx.frame)))
    )


def _fresh(ctx: SeedContext, seed: int = 0, **changes: Any) -> SeedContext:
    """The same context with nothing cached, a copy of its memory, and its generator at the
    start."""
    generator = torch.Generator().manual_seed(seed)
    return dataclasses.replace(ctx, generator=generator, memory=copy_memory(ctx.memory), **changes)


def _run_unchanged(subject: "_Tested", ctx: SeedContext, where: str) -> Seeds:
    """Run once; frame and maps must be bit for bit the same afterwards."""
    fresh = _fresh(ctx)
    _ = fresh.frame.rgb
    with _refuse_changes(fresh, where):
        return subject.seeds(fresh)


@contextmanager
def _refuse_changes(ctx: SeedContext, where: str) -> Iterator[None]:
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


def _check_walk(
    subject: "_Tested",
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
        ctx = _with_extra(walk.context(number, memory), extra)
        first = _run_unchanged(subject, ctx, place)
        memory_after = _check_randomness(subject, ctx, first, place)
        _check_in_front(first, ctx.frame, place)
        _check_nothing_kept(rule, code_hash, place)
        walk.grow(first)
        if is_map_rule(rule) and rule.after_step is not MapRule.after_step:
            ctx = dataclasses.replace(ctx, memory=memory_after)
            for step, stage in _STEPS:
                memory_after = _check_after_step(
                    subject.instance(), ctx, step, stage, f"{place}, after step {step} ({stage})"
                )
                ctx = dataclasses.replace(ctx, memory=memory_after)
            _check_nothing_kept(rule, code_hash, place)
        total = total + len(first)
        memory = memory_after
    all_given.add((vars(walk.gaussians.params), memory))
    return total


def _check_after_step(
    rule: MapRule, ctx: SeedContext, step: int, stage: Literal["online", "passes"], where: str
) -> dict[str, Any]:
    """``after_step`` changes nothing but its memory, returns the same twice, and its edit fits the
    map, which then has it. Returns the memory afterwards."""
    stats = _step_stats(rule, ctx, step, stage)
    edits = []  # statistics may be restarted
    memories = []
    second = copy.deepcopy(ctx.gaussians)
    for seed, model in ((1, ctx.gaussians), (2, second)):
        fresh = _fresh(ctx, gaussians=model)
        with _refuse_changes(fresh, where), _other_generators(seed):
            edit = rule.after_step(fresh, stats, fresh.memory)
        if edit is not None and not isinstance(edit, Edit):
            raise KindError(f"{where}: after_step must return an Edit or None, got {shown(edit)}")
        check_memory(rule_name(type(rule)), fresh.memory)
        edits.append(edit)
        memories.append(fresh.memory)
    if not equal_memories(*map(_as_memory, edits)) or not equal_memories(*memories):
        raise AssertionError(
            f"{where}: two calls with the same input gave different edits, or different memories"
        )
    if edits[0] is not None:
        try:
            ctx.gaussians.edit(
                edits[0],
                torch.Generator().manual_seed(step),
                ctx.frame.index,
            )
        except ValueError as e:
            raise AssertionError(
                f"{where}: it returned an edit that is not possible: {e}"
            ) from None
    return memories[0]


def _step_stats(
    rule: MapRule, ctx: SeedContext, step: int, stage: Literal["online", "passes"]
) -> StepStats:
    """Statistics that the rule asks for, with random gradients."""
    needs = rule.statistics()
    model = ctx.gaussians
    frame = ctx.frame
    check_needs(needs, f"seeding rule {rule_name(type(rule))!r}: statistics()")
    screen = footprints(model.params, frame.camera, frame.T_WC) if needs - {"render"} else None
    v_random = 1e-3 * torch.randn(
        len(model),
        2,
        generator=torch.Generator().manual_seed(step),
    )
    v_uv, v_uv_abs = (
        value if name in needs else None
        for name, value in (
            ("image_gradients", v_random),
            ("abs_image_gradients", 2 * v_random.abs()),
        )
    )
    if screen is not None:
        add_up(model, screen.visible, v_uv, frame.camera, v_uv_abs)
    return StepStats(
        step=step,
        stage=stage,
        step_in_frame=1,
        steps_in_frame=1,
        frame_index=frame.index,
        camera=frame.camera,
        T_WC=frame.T_WC,
        target=frame.rgb,
        loss=torch.tensor(0.1),
        rgb=render(model.params, frame.camera, frame.T_WC).rgb if "render" in needs else None,
        visible=None if screen is None else screen.visible,
        radius_px=None if screen is None else screen.radius_px,
        v_uv=v_uv,
        v_uv_abs=v_uv_abs,
    )


def _as_memory(edit: Edit | None) -> dict[str, Any] | None:
    if edit is None:
        return None
    return {
        k: vars(v) if isinstance(v, Seeds) else dict(v) if isinstance(v, Mapping) else v
        for k, v in vars(edit).items()
    }


def _check_nothing_kept(rule: SeedingRule, code_hash: str, where: str) -> None:
    """The rule stores nothing new after all these runs, except in the memory of a context."""
    if loaded_values(rule) != code_hash:
        raise AssertionError(
            f"{where}: it keeps something from one frame to the next (a global, a variable around "
            "it, an attribute); its seeds may depend on the context only: keep it in ctx.memory"
        )


def _check_randomness(
    subject: "_Tested", ctx: SeedContext, first: Seeds, where: str
) -> dict[str, Any]:
    """Runs on equal inputs give equal seeds, and leave equal memories. Returns the memory
    afterwards."""
    memories = []
    for seed in (1, 2):
        fresh = _fresh(ctx)
        with _other_generators(seed):
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


def _check_in_front(seeds: Seeds, frame: Frame, where: str) -> None:
    z = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)[:, 2]
    n_behind = int((z <= 0).sum())
    if n_behind:
        raise AssertionError(
            f"{where}: {n_behind} of {len(seeds)} seeds lie behind the camera; xyz_W is in the "
            "world frame, T_WC applied"
        )


def _check_missing_depth(subject: "_Tested", ctx: SeedContext, where: str) -> None:
    blind = dataclasses.replace(ctx.frame, depth_m=torch.zeros_like(ctx.frame.depth_m))
    n_seeds = len(subject.seeds(_fresh(ctx, frame=blind)))
    if n_seeds:
        raise AssertionError(
            f"{where}: the frame has no depth, yet it gave {n_seeds} seeds; there is no surface to "
            "seed"
        )


def _check_every_option(subject: "_Tested", ctx: SeedContext, first: Seeds, where: str) -> None:
    """Passing the defaults by name changes nothing; every switch and every choice works."""
    defaults = rule_options(subject.rule) | subject.options
    if not equal_memories(vars(first), vars(subject.seeds(_fresh(ctx), defaults))):
        raise AssertionError(
            f"{where}: passing its own defaults {defaults} by name gave other seeds than leaving "
            "them out"
        )
    for options in _other_options(defaults, rule_choices(subject.rule)):
        seeds = subject.seeds(_fresh(ctx), options)
        _check_in_front(seeds, ctx.frame, f"{where}, with {options}")


def _other_options(
    defaults: dict[str, Option], choices: dict[str, tuple[str, ...]]
) -> Iterable[dict[str, Option]]:
    for name, default in defaults.items():
        if isinstance(default, bool):
            yield {name: not default}
        for word in choices.get(name, ()):
            yield {name: word}


@contextmanager
def _other_generators(seed: int) -> Iterator[None]:
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
