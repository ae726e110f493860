"""The properties of ``MapRule.after_step``, which a walk tests with random gradients."""

import copy
from collections.abc import Mapping
from typing import Any, Literal

import torch

from ..checks import shown
from ..errors import KindError
from ..gaussians import Edit
from ..render import footprints, render
from ..types import Seeds
from .context import SeedContext
from .map_rule import MapRule, StepStats, check_needs, rule_name
from .memory import check_memory, equal_memories
from .points import add_up
from .rule_properties import fresh_context, other_generators, refuse_changes


def check_after_step(
    rule: MapRule, ctx: SeedContext, step: int, stage: Literal["online", "passes"], where: str
) -> dict[str, Any]:
    """``after_step`` changes nothing but its memory, returns the same twice, and its edit fits the
    map, which then has it. Returns the memory afterwards."""
    stats = _step_stats(rule, ctx, step, stage)
    edits = []  # statistics may be restarted
    memories = []
    second = copy.deepcopy(ctx.gaussians)
    for seed, model in ((1, ctx.gaussians), (2, second)):
        fresh = fresh_context(ctx, gaussians=model)
        with refuse_changes(fresh, where), other_generators(seed):
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
