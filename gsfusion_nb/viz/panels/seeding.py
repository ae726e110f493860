"""Panel of a seeding rule: where it places Gaussians in a frame."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ... import seeding
from ...drawing.pictures import Picture, to_uint8
from ...errors import ArgumentError, UnknownNameError
from ...gaussians import GaussianModel
from ...geometry import project, se3
from ...mapping import GSFusion
from ...optim import take_missed_steps
from ...render import render
from ...seeding import SeedContext, SeedingRule, apply_rule, rule_name
from ...tsdf import TsdfVolume, integrate
from ...types import Frame, Seeds
from ..map_pictures import paint_points
from ..mapped_frame import SEED_COLOUR
from .panel import Choice, Control, Drawn, Panel, Slider, Switch

RULE_SHOWS = ("places", "new Gaussians", "map and new")
REACH = 20.0
"""A slider goes from default / REACH to default x REACH."""


def rule_controls(
    rule: str | SeedingRule,
    ranges: Mapping[str, tuple[float | int, float | int]] | None = None,
) -> dict[str, Control]:
    """A control for each option of a rule, at its default.

    A bool becomes a check box, a word a menu of the allowed words, an int a slider up to 4 times
    its default, a positive float a slider from 1/20 to 20 times its default, any other float a
    slider from default - 1 to default + 1. Paths and free texts have no control and keep their
    defaults.

    Args:
        rule: Name or function.
        ranges: Option -> its smallest and largest value, where the default range does not fit; two
            ints give whole steps.

    Raises:
        KeyError: no such rule, or ``ranges`` names no option of it.
    """
    options = seeding.rule_options(rule)
    words = seeding.rule_choices(rule)
    ranges = dict(ranges or {})
    unknown = sorted(set(ranges) - set(options))
    if unknown:
        raise UnknownNameError(
            f"rule {rule_name(rule)!r} has no options {unknown}; known: {sorted(options)}"
        )
    return {
        name: _control(
            name,
            default,
            words.get(name, ()),
            ranges.get(name),
        )
        for name, default in options.items()
        if name in words or isinstance(default, bool | int | float)
    }


def _control(
    name: str,
    default: Any,
    words: Sequence[str],
    limits: tuple[float | int, float | int] | None,
) -> Control:
    if isinstance(default, bool):
        return Switch(value=default, label=name)
    if isinstance(default, str):
        return Choice(value=default, options=words, label=name)
    if isinstance(default, int):
        low, high = limits or (min(default, 1), max(4, 4 * default))
        return Slider(
            value=default,
            low=int(low),
            high=int(high),
            step=1,
            label=name,
        )
    usual = (default / REACH, default * REACH) if default > 0 else (default - 1, default + 1)
    low, high = limits or usual
    whole = bool(limits) and all(isinstance(limit, int) for limit in limits or ())
    log = low > 0 and not whole
    step = 1.0 if whole else 0.02 if log else (high - low) / 100
    return Slider(
        value=default,
        low=low,
        high=high,
        step=step,
        label=name,
        log=log,
        readout=".3g",
    )


def rule_context(mapper: GSFusion, frame: Frame) -> SeedContext:
    """What a rule would see if ``mapper`` mapped ``frame`` next; the mapper is not changed.

    The volume is copied and the frame is fused into the copy: a rule sees the volume with the new
    frame in it.
    """
    volume = TsdfVolume(mapper.config.tsdf, device=mapper.device)
    volume.load_state_dict(copy.deepcopy(mapper.volume.state_dict()))
    integrate(volume, frame)
    gaussians = GaussianModel.from_state_dict(copy.deepcopy(mapper.gaussians.state_dict()))
    take_missed_steps(gaussians, mapper.row_optim)
    ctx = mapper.seed_context(frame)
    return dataclasses.replace(
        ctx,
        volume=volume,
        gaussians=gaussians,
        reading=dataclasses.replace(ctx.reading, params=None),
        generator=torch.Generator().manual_seed(0),
        memory=seeding.copy_memory(mapper.rule_in_use.memory),
    )


def rule_picture(
    rule: str | SeedingRule,
    ctx: SeedContext,
    options: Mapping[str, Any] | None = None,
    *,
    show: str = "places",
    scale: int = 1,
) -> tuple[Picture, Seeds]:
    """The seeds that a rule proposes for a frame, drawn, and the seeds themselves.

    "places": red dots over the darkened photograph; "new Gaussians": the seeds alone, rendered;
    "map and new": the seeds rendered together with the map of the context, which is where the
    optimisation starts.

    Args:
        rule: Name or function.
        ctx: The frame, and what was mapped before. Its generator is seeded with 0 first, and its
            memory is restored afterwards, so the picture repeats.
        options: Keyword arguments for the rule.
        show: What is drawn, one of ``RULE_SHOWS``.
        scale: Enlargement.

    Raises:
        ValueError: unknown ``show``; also whatever the rule raises.
    """
    if show not in RULE_SHOWS:
        raise ArgumentError(f"show must be one of {', '.join(RULE_SHOWS)}, got {show!r}")
    ctx.generator.manual_seed(0)
    memory = seeding.copy_memory(ctx.memory)
    try:
        seeds = apply_rule(rule, ctx, options)
    finally:
        ctx.memory.clear()
        ctx.memory.update(memory)
    if show != "places":
        return _render_seeds(ctx, seeds, with_map=show == "map and new").repeat(scale, 0).repeat(
            scale, 1
        ), seeds
    picture = (to_uint8(ctx.frame.colour).repeat(scale, 0).repeat(scale, 1) * 0.5).astype(np.uint8)
    xyz_C = se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W)
    paint_points(
        picture,
        project(ctx.camera, xyz_C[xyz_C[:, 2] > 0]) * scale - 1,
        SEED_COLOUR,
    )
    return picture, seeds


def rule_panel(
    rule: str | SeedingRule,
    contexts: SeedContext | Mapping[str, SeedContext],
    *,
    ranges: Mapping[str, tuple[float | int, float | int]] | None = None,
    scale: int = 1,
) -> Panel:
    """Controls for a rule's options, and the seeds that it proposes for a frame.

    Args:
        rule: Name or function.
        contexts: A context from ``rule_context``, or several by name to choose from.
        ranges: As for ``rule_controls``.
        scale: Enlargement of the picture.
    """
    scenes = {"frame": contexts} if isinstance(contexts, SeedContext) else dict(contexts)
    own = rule_controls(rule, ranges)
    extra: dict[str, Control] = {
        "show": Choice(value=RULE_SHOWS[0], options=RULE_SHOWS, label="show")
    }
    if len(scenes) > 1:
        extra = {
            "scene": Choice(
                value=next(iter(scenes)),
                options=list(scenes),
                label="scene",
            ),
            **extra,
        }
    name_clashes = sorted(set(own) & {"scene", "show"})
    if name_clashes:
        raise ArgumentError(
            f"rule {rule_name(rule)!r} has an option named {name_clashes[0]!r}, which the panel "
            "needs itself"
        )

    def draw(**values: Any) -> Drawn:
        ctx = scenes[values.pop("scene", next(iter(scenes)))]
        picture, seeds = rule_picture(
            rule,
            ctx,
            values,
            show=values.pop("show"),
            scale=scale,
        )
        pixels = int(ctx.has_depth().sum())
        each = f", one for every {pixels / len(seeds):.0f} pixels with depth" if len(seeds) else ""
        sizes = f"<br>{_sizes(seeds)}" if len(seeds) else ""
        return picture, f'<b class="gsnb-rule-count">{len(seeds):,}</b> new Gaussians{each}{sizes}'

    return Panel(draw, {**own, **extra}, name="rule", text=f"seeds of rule {rule_name(rule)!r}")


def _sizes(seeds: Seeds) -> str:
    size_cm = 100 * seeds.scale_m.amax(dim=1)
    low, mid, high = size_cm.quantile(torch.tensor([0.1, 0.5, 0.9]).to(size_cm)).tolist()
    return f"standard deviation: median {mid:.2g} cm, 80 % between {low:.2g} and {high:.2g} cm"


def _render_seeds(ctx: SeedContext, seeds: Seeds, *, with_map: bool) -> Picture:
    model = GaussianModel(sh_degree=0)
    if with_map and ctx.gaussians is not None and len(ctx.map):
        map_view = ctx.map
        old = Seeds(
            xyz_W=map_view.xyz_W,
            rgb=ctx.gaussians.rgb.clamp(0, 1),
            scale_m=map_view.scale_m,
            quat=map_view.quat,
            opacity=map_view.opacity.clamp(1e-4, 1 - 1e-4),
            tag=torch.zeros(len(map_view), dtype=torch.int32),
        )
        model.append(old)
    model.append(dataclasses.replace(seeds, tag=seeds.tag.to(torch.int32)))
    if len(model) == 0:
        return np.zeros((ctx.camera.height, ctx.camera.width, 3), np.uint8)
    near_m = ctx.reading.near_plane_m
    return to_uint8(render(model.params, ctx.camera, ctx.frame.T_WC, near_m=near_m).rgb)
