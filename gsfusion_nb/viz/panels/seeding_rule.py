"""A panel about a seeding rule: controls made from its options, and where it places Gaussians in a frame."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ...drawing.pictures import Picture, to_uint8
from ...gaussians import GaussianModel
from ...geometry import camera as pinhole
from ...geometry import se3
from ...mapping import GSFusion
from ...render import render
from ...seeding import SeedContext, SeedingRule, apply_rule, copy_memory, rule_choices, rule_name, rule_options
from ...tsdf import TsdfVolume, integrate
from ...types import Frame, Seeds
from .panel import Choice, Control, Drawn, Panel, Slider, Switch

SHOWS = ("places", "new Gaussians", "map and new")
SEED_COLOUR = (255, 48, 64)
REACH = 20.0
"""A slider goes from default / REACH to default x REACH."""


def rule_controls(
    rule: str | SeedingRule, ranges: Mapping[str, tuple[float | int, float | int]] | None = None
) -> dict[str, Control]:
    """A control for each option of a rule, at its default.

    A bool becomes a check box, a word a menu of the allowed words, an int a slider up to 4 times its default, a
    positive float a slider from 1/20 to 20 times its default, any other float a slider from default - 1 to default + 1.
    Paths and free texts have no control and keep their defaults.

    Args:
        rule: Name or function.
        ranges: Option -> its smallest and largest value, where the default range does not fit; two ints give whole
            steps.

    Raises:
        KeyError: no such rule, or ``ranges`` names no option of it.
    """
    options, words, ranges = rule_options(rule), rule_choices(rule), dict(ranges or {})
    unknown = sorted(set(ranges) - set(options))
    if unknown:
        raise KeyError(f"rule {rule_name(rule)!r} has no options {unknown}; known: {sorted(options)}")
    return {
        name: _control(name, default, words.get(name, ()), ranges.get(name))
        for name, default in options.items()
        if name in words or isinstance(default, bool | int | float)
    }


def _control(name: str, default: Any, words: Sequence[str], limits: tuple[float | int, float | int] | None) -> Control:
    if isinstance(default, bool):
        return Switch(value=default, label=name)
    if isinstance(default, str):
        return Choice(value=default, options=words, label=name)
    if limits and all(isinstance(limit, int) for limit in limits) and not isinstance(default, int):
        return Slider(value=default, low=limits[0], high=limits[1], step=1.0, label=name, readout=".3g")
    if isinstance(default, int):
        low, high = limits or (min(default, 1), max(4, 4 * default))
        return Slider(value=default, low=int(low), high=int(high), step=1, label=name)
    if default > 0:
        low, high = limits or (default / REACH, default * REACH)
        if low > 0:
            return Slider(value=default, low=low, high=high, step=0.02, label=name, log=True, readout=".3g")
        return Slider(value=default, low=low, high=high, step=(high - low) / 100, label=name, readout=".3g")
    low, high = limits or (default - 1, default + 1)
    return Slider(value=default, low=low, high=high, step=(high - low) / 100, label=name, readout=".3g")


def rule_context(mapper: GSFusion, frame: Frame) -> SeedContext:
    """What a rule would see if ``mapper`` mapped ``frame`` next; the mapper is not changed.

    The volume is copied and the frame is fused into the copy: a rule sees the volume with the new frame in it.
    """
    volume = TsdfVolume(mapper.config.tsdf, device=mapper.device)
    volume.load_state_dict(_copied(mapper.volume.state_dict()))
    integrate(volume, frame)
    return dataclasses.replace(
        mapper.seed_context(frame),
        volume=volume,
        gaussians=GaussianModel.from_state_dict(_copied(mapper.gaussians.state_dict())),
        generator=torch.Generator().manual_seed(0),
        memory=copy_memory(mapper.memory),
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

    "places": red dots over the darkened photograph; "new Gaussians": the seeds alone, rendered; "map and new": the
    seeds rendered together with the map of the context, which is where the optimisation starts.

    Args:
        rule: Name or function.
        ctx: The frame, and what was mapped before. Its generator is seeded with 0 first, and its memory is restored
            afterwards, so the picture repeats.
        options: Keyword arguments for the rule.
        show: What is drawn, one of ``SHOWS``.
        scale: Enlargement.

    Raises:
        ValueError: unknown ``show``; also whatever the rule raises.
    """
    if show not in SHOWS:
        raise ValueError(f"show must be one of {', '.join(SHOWS)}, got {show!r}")
    ctx.generator.manual_seed(0)
    memory = copy_memory(ctx.memory)
    try:
        seeds = apply_rule(rule, ctx, options)
    finally:
        ctx.memory.clear()
        ctx.memory.update(memory)
    if show == "places":
        picture = _with_dots(
            (to_uint8(ctx.frame.colour).repeat(scale, 0).repeat(scale, 1) * 0.5), ctx.frame, seeds, scale
        )
    else:
        picture = _rendered(ctx, seeds, with_map=show == "map and new").repeat(scale, 0).repeat(scale, 1)
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
    extra: dict[str, Control] = {"show": Choice(value=SHOWS[0], options=SHOWS, label="show")}
    if len(scenes) > 1:
        extra = {"scene": Choice(value=next(iter(scenes)), options=list(scenes), label="scene"), **extra}
    taken = sorted(set(own) & {"scene", "show"})
    if taken:
        raise ValueError(f"rule {rule_name(rule)!r} has an option named {taken[0]!r}, which the panel needs itself")

    def draw(**values: Any) -> Drawn:
        ctx = scenes[values.pop("scene", next(iter(scenes)))]
        picture, seeds = rule_picture(rule, ctx, values, show=values.pop("show"), scale=scale)
        pixels = int(ctx.has_depth().sum())
        each = f", one for every {pixels / len(seeds):.0f} pixels with depth" if len(seeds) else ""
        sizes = f"<br>{_sizes(seeds)}" if len(seeds) else ""
        return picture, f'<b class="gsnb-rule-count">{len(seeds):,}</b> new Gaussians{each}{sizes}'

    return Panel(draw, {**own, **extra}, name="rule", text=f"seeds of rule {rule_name(rule)!r}")


def _sizes(seeds: Seeds) -> str:
    size_cm = 100 * seeds.scale_m.amax(dim=1)
    low, mid, high = size_cm.quantile(torch.tensor([0.1, 0.5, 0.9]).to(size_cm)).tolist()
    return f"standard deviation: median {mid:.2g} cm, 80 % between {low:.2g} and {high:.2g} cm"


def _with_dots(picture: np.ndarray, frame: Frame, seeds: Seeds, scale: int) -> Picture:
    image = picture.astype(np.uint8)
    xyz_C = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)
    uv = pinhole.project(frame.camera, xyz_C[xyz_C[:, 2] > 0]).cpu().numpy() * scale
    at = np.floor(uv[np.isfinite(uv).all(1)]).clip(-9, 1e6).astype(int)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = at[:, 0] - 1 + dx, at[:, 1] - 1 + dy
        inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        image[y[inside], x[inside]] = SEED_COLOUR
    return image


def _rendered(ctx: SeedContext, seeds: Seeds, *, with_map: bool) -> Picture:
    model = GaussianModel(sh_degree=0)
    if with_map and ctx.gaussians is not None and len(ctx.map):
        known = ctx.map
        old = Seeds(
            xyz_W=known.xyz_W, rgb=_view_colours(ctx), scale_m=known.scale_m, quat=known.quat,
            opacity=known.opacity.clamp(1e-4, 1 - 1e-4), tag=torch.zeros(len(known), dtype=torch.int32),
        )  # fmt: skip
        model.append(old)
    model.append(dataclasses.replace(seeds, tag=seeds.tag.to(torch.int32)))
    if len(model) == 0:
        return np.zeros((ctx.camera.height, ctx.camera.width, 3), np.uint8)
    return to_uint8(render(model.params, ctx.camera, ctx.frame.T_WC).rgb)


def _view_colours(ctx: SeedContext) -> torch.Tensor:
    """Colours of the map without their view-dependent part."""
    model: GaussianModel = ctx.gaussians
    return model.rgb.clamp(0, 1)


def _copied(state: Any) -> Any:
    """Tensors in nested dictionaries and lists, cloned."""
    if isinstance(state, torch.Tensor):
        return state.clone()
    if isinstance(state, dict):
        return {name: _copied(value) for name, value in state.items()}
    return [_copied(v) for v in state] if isinstance(state, list) else state
