"""``check_rule`` tests on small built-in scenes whether a seeding rule keeps the contract."""

import copy
import dataclasses
import pickle
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from ..errors import shown
from ..gaussians import Edit
from ..geometry import se3
from ..render import footprints, render
from ..types import Frame, Seeds
from .apply import ChangedInputError, apply_rule, context_tensors
from .check_scenes import Walk, check_contexts
from .context import SeedContext
from .fingerprint import rule_fingerprint
from .map_rule import MapRule
from .memory import check_memory, copy_memory, equal_memories
from .rule import Option, SeedingRule, get_rule, is_map_rule, rule_choices, rule_name, rule_options
from .step_stats import StepStats, add_up, check_needs

_STEPS: tuple[tuple[int, Literal["online", "passes"]], ...] = ((1, "online"), (600, "online"), (3000, "passes"))
"""Steps after which ``after_step`` is called; published strategies act every 100 or 3,000 steps from 500 on."""


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


def check_rule(
    rule: str | SeedingRule,
    contexts: dict[str, SeedContext] | None = None,
    *,
    extra: Callable[[Frame], Mapping[str, Any]] | None = None,
) -> RuleCheck:
    """Check the contract of a seeding rule: valid seeds, in front of the camera, none without depth, repeatable, and no
    change to the frame or the map.

    It runs in single frames, and through a walk in which a map grows from its own seeds and its memory is kept. There
    ``after_step`` of a class is called, too, with random gradients, and its edits are made. For a map that GSFusion
    optimised, see ``gsfusion_nb.runs.mapped_contexts``.

    Args:
        rule: Name, function or class; it need not be registered.
        contexts: Scenes by name, in place of the built-in ones and of the walk.
        extra: Gives each frame the further images that the rule reads, as for ``open_sequence``.

    Returns:
        A report, printed as text.

    Raises:
        AssertionError: a property does not hold; the message names rule, scene and property.
        TypeError, ValueError: wrong signature, or invalid seeds.
    """
    function, name = get_rule(rule), rule_name(rule)
    scenes = check_contexts() if contexts is None else contexts
    counts, kept = {}, rule_fingerprint(function)
    for scene, given in scenes.items():
        ctx = _with_extra(given, extra)
        where = f"seeding rule {name!r}, scene {scene!r}"
        first = _run_unchanged(function, ctx, where)
        _check_randomness(function, ctx, first, where)
        _check_in_front(first, ctx.frame, where)
        _check_missing_depth(function, ctx, where)
        _check_every_option(function, ctx, first, where)
        _check_nothing_kept(function, kept, where)
        counts[scene] = len(first)
    edits = contexts is None and is_map_rule(function) and function.after_step is not MapRule.after_step
    if contexts is None:
        counts["walk"] = _check_walk(function, kept, extra, f"seeding rule {name!r}, scene 'walk'")
    passed = (
        "columns of the right shape, finite, scale > 0, opacity in (0, 1), colour in 0..1",
        "changes neither the frame nor the map",
        "same input, same output; random numbers only from ctx.generator",
        "nothing kept from one frame to the next, except in ctx.memory",
        "seeds lie in front of the camera",
        "no depth, no seeds",
        f"every option is accepted: {', '.join(rule_options(function)) or '(it has none)'}",
        *(["after_step: possible edits, the same twice, no change of its inputs"] if edits else []),
    )
    return RuleCheck(name, passed, counts)


def _with_extra(ctx: SeedContext, extra: Callable[[Frame], Mapping[str, Any]] | None) -> SeedContext:
    if extra is None:
        return ctx
    return dataclasses.replace(ctx, frame=dataclasses.replace(ctx.frame, extra=dict(extra(ctx.frame))))


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


def _check_walk(rule: SeedingRule, kept: str, extra: Any, where: str) -> int:
    """Several frames in which a map grows from the rule's own seeds. Returns the number of seeds."""
    total, memory = 0, {}
    walk = Walk()
    for number in range(walk.n_frames):
        here, ctx = f"{where}, frame {number}", _with_extra(walk.context(number, memory), extra)
        first = _run_unchanged(rule, ctx, here)
        after = _check_randomness(rule, ctx, first, here)
        _check_in_front(first, ctx.frame, here)
        _check_nothing_kept(rule, kept, here)
        walk.grow(first)
        if is_map_rule(rule) and rule.after_step is not MapRule.after_step:
            ctx = dataclasses.replace(ctx, memory=after)
            for step, stage in _STEPS:
                after = _check_after_step(rule(), ctx, step, stage, f"{here}, after step {step} ({stage})")
                ctx = dataclasses.replace(ctx, memory=after)
            _check_nothing_kept(rule, kept, here)
        total, memory = total + len(first), after
    return total


def _check_after_step(
    rule: MapRule, ctx: SeedContext, step: int, stage: Literal["online", "passes"], where: str
) -> dict[str, Any]:
    """``after_step`` changes nothing but its memory, returns the same twice, and its edit fits the map, which then has
    it. Returns the memory afterwards."""
    given = _step_stats(rule, ctx, step, stage)
    edits, memories, second = [], [], copy.deepcopy(ctx.gaussians)  # statistics may be restarted
    for seed, model in ((1, ctx.gaussians), (2, second)):
        fresh = _fresh(ctx, gaussians=model)
        watched = [(name, tensor, tensor.clone()) for name, tensor in context_tensors(fresh)]
        with _other_generators(seed):
            edit = rule.after_step(fresh, given, fresh.memory)
        if edit is not None and not isinstance(edit, Edit):
            raise TypeError(f"{where}: after_step must return an Edit or None, got {shown(edit)}")
        check_memory(rule_name(type(rule)), fresh.memory)
        for name, tensor, before in watched:
            if not torch.equal(tensor, before):
                raise AssertionError(_changed(where, name))
        edits.append(edit)
        memories.append(fresh.memory)
    if not equal_memories(*map(_as_memory, edits)) or not equal_memories(*memories):
        raise AssertionError(f"{where}: two calls with the same input gave different edits, or different memories")
    if edits[0] is not None:
        try:
            ctx.gaussians.edit(edits[0], torch.Generator().manual_seed(step), ctx.frame.index)
        except ValueError as e:
            raise AssertionError(f"{where}: it returned an edit that is not possible: {e}") from None
    return memories[0]


def _step_stats(rule: MapRule, ctx: SeedContext, step: int, stage: Literal["online", "passes"]) -> StepStats:
    """Statistics that the rule asks for, with random gradients."""
    needs, model, frame = rule.statistics(), ctx.gaussians, ctx.frame
    check_needs(needs, f"seeding rule {rule_name(type(rule))!r}: statistics()")
    seen = footprints(model.params, frame.camera, frame.T_WC) if needs - {"render"} else None
    drawn = 1e-3 * torch.randn(len(model), 2, generator=torch.Generator().manual_seed(step))
    v_uv, v_uv_abs = (
        value if name in needs else None
        for name, value in (("image_gradients", drawn), ("abs_image_gradients", 2 * drawn.abs()))
    )
    if seen is not None:
        add_up(model, seen.visible, v_uv, frame.camera, v_uv_abs)
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
        visible=None if seen is None else seen.visible,
        radius_px=None if seen is None else seen.radius_px,
        v_uv=v_uv,
        v_uv_abs=v_uv_abs,
    )


def _as_memory(edit: Edit | None) -> dict[str, Any] | None:
    if edit is None:
        return None
    return {
        k: vars(v) if isinstance(v, Seeds) else dict(v) if isinstance(v, Mapping) else v for k, v in vars(edit).items()
    }


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
