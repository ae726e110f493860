"""``check_rule``: does a seeding rule keep the contract? On small scenes made here, without any data."""

import dataclasses
import pickle
import random
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..config import SeedingConfig, TsdfConfig
from ..geometry import pixel_grid, rays, se3
from ..types import Camera, Frame, GaussianParams, Seeds
from .context import SeedContext
from .rule import Option, SeedingRule, apply_rule, get_rule, rule_choices, rule_name, rule_options

_TSDF = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)
_SPHERE = ((0.1, 0.05, 1.3), 0.3)
_WALL = ((0.2, 0.0, -1.0), -1.9)
"""Normal (not of unit length) and offset: points with normal . p = offset, a slanted wall near z = 2."""


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
    """Run the contract of a seeding rule: sound rows, in front of the camera, none without depth, repeatable, and
    nothing touched that is not its own.

    Args:
        rule: Name or function; it need not be registered.
        contexts: Scenes by name, in place of the built ones.

    Returns:
        A report, printed as text.

    Raises:
        AssertionError: a broken property, in a sentence that names rule, scene and property.
        TypeError, ValueError: bad signature, or seeds that no map could take.
    """
    function, name = get_rule(rule), rule_name(rule)
    scenes = check_contexts() if contexts is None else contexts
    counts = {}
    for scene, ctx in scenes.items():
        where = f"seeding rule {name!r}, scene {scene!r}"
        first = _run_untouched(function, ctx, where)
        _check_randomness(function, ctx, first, where)
        _check_in_front(first, ctx.frame, where)
        _check_missing_depth(function, ctx, where)
        _check_every_option(function, ctx, first, where)
        counts[scene] = len(first)
    passed = (
        "columns of the right shape, finite, scale > 0, opacity in (0, 1), colour in 0..1",
        "changes neither the frame nor the map",
        "same input, same output; random numbers only from ctx.generator",
        "seeds lie in front of the camera",
        "no depth, no seeds",
        f"every option is taken: {', '.join(rule_options(function)) or '(it has none)'}",
    )
    return RuleCheck(name, passed, counts)


def check_contexts() -> dict[str, SeedContext]:
    """Small made-up scenes by name: a textured slanted wall with a sphere before it, seen from a tilted camera.

    "new": nothing mapped yet; "half seen": the left half was observed before and has Gaussians; "holes": depth missing
    in stripes; "dark": no depth at all; "odd": 7 x 5 pixels; "tiny": one pixel.
    """
    new = _scene_frame(61, 47)
    stripes = new.depth_m * (torch.arange(61) % 3 > 0)
    frames = {
        "new": new,
        "half seen": new,
        "holes": dataclasses.replace(new, depth_m=stripes),
        "dark": dataclasses.replace(new, depth_m=torch.zeros_like(new.depth_m)),
        "odd": _scene_frame(7, 5),
        "tiny": _scene_frame(1, 1),
    }
    # an absolute variance threshold would leave images this small in one piece
    config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    contexts = {}
    for name, frame in frames.items():
        seen_left = name == "half seen"
        volume = SceneVolume(frame.T_WC, seen_left)
        contexts[name] = SeedContext(frame, volume, _scene_map(frame, seen_left), config=config)
    return contexts


class SceneVolume:
    """The made-up scene as a TSDF volume that needs no integration: distances come from its formula.

    Voxels in the truncation band have weight 1, or 3 in the left half of the view if that ``seen_left``.
    """

    def __init__(self, T_WC: Float[Tensor, "4 4"], seen_left: bool):
        self.config = _TSDF
        self._T_CW = se3.inverse(T_WC)
        self._seen_left = seen_left

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> Any:
        """``D``, ``W`` and ``rgb`` at the centres of the voxels that contain the points."""
        size = self.config.voxel_size_m
        centre = ((xyz_W / size).floor() + 0.5) * size
        xyz_C = se3.apply(self._T_CW, centre)
        D = (_distance(xyz_C) / self.config.truncation_m).clamp(-1.0, 1.0)
        W = torch.ones_like(D)
        if self._seen_left:
            W[xyz_C[:, 0] < 0] = 3.0
        W[D.abs() >= 1] = 0.0
        return SimpleNamespace(D=D, W=W, rgb=torch.full_like(xyz_C, 0.5))


def _distance(xyz_C: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    centre, radius = xyz_C.new_tensor(_SPHERE[0]), _SPHERE[1]
    normal = xyz_C.new_tensor(_WALL[0])
    wall = (xyz_C @ normal - _WALL[1]) / normal.norm()
    return torch.minimum(wall, (xyz_C - centre).norm(dim=-1) - radius)


def _scene_frame(width: int, height: int) -> Frame:
    """The scene by exact ray casting, four plain quarters of a wall, stripes on the sphere: cells of several sizes."""
    camera = Camera(width=width, height=height, fx=float(width), fy=float(width), cx=width / 2, cy=height / 2)
    ray = rays(camera, pixel_grid(camera))
    z_wall = _WALL[1] / (ray @ ray.new_tensor(_WALL[0]))
    centre, radius = ray.new_tensor(_SPHERE[0]), _SPHERE[1]
    a, b, c = (ray * ray).sum(-1), ray @ centre, centre @ centre - radius**2
    root = b * b - a * c
    z_sphere = torch.where(root > 0, (b - root.clamp_min(0).sqrt()) / a, torch.inf)
    depth_m = torch.minimum(z_wall, z_sphere)
    point = ray * depth_m[..., None]
    checks = ((point[..., :2] > 0).sum(-1) % 2)[..., None]
    stripes = 0.5 + 0.5 * torch.sin(point * torch.tensor([40.0, 3.0, 11.0]))
    rgb = torch.where((z_sphere < z_wall)[..., None], stripes, 0.25 + 0.5 * checks.expand_as(stripes))
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.2, 2.0, -0.3]))
    return Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera, T_WC=T_WC)


def _scene_map(frame: Frame, seen_left: bool) -> Any:
    """Gaussians on the left part of the scene, or none."""
    W = frame.camera.width
    uv = pixel_grid(frame.camera)[::8, : W // 2 : 8].reshape(-1, 2) if seen_left else torch.zeros(0, 2)
    z = frame.depth_m[uv[:, 1].long(), uv[:, 0].long()]
    xyz_W = se3.apply(frame.T_WC, rays(frame.camera, uv) * z[:, None])
    n = len(uv)
    quat = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    params = GaussianParams(
        xyz_W=xyz_W,
        log_scale=torch.full((n, 3), -3.0),
        quat=quat,
        opacity_logit=torch.full((n,), 2.0),
        sh=torch.zeros(n, 1, 3),
    )
    return SimpleNamespace(params=params)


def _fresh(ctx: SeedContext, seed: int = 0, **changes: Any) -> SeedContext:
    """The same context with nothing cached and its generator at the start."""
    return dataclasses.replace(ctx, generator=torch.Generator().manual_seed(seed), **changes)


def _run_untouched(rule: SeedingRule, ctx: SeedContext, where: str) -> Seeds:
    """One run, after which frame and map must be bit for bit what they were."""
    watched = {f"frame.{name}": getattr(ctx.frame, name) for name in ("rgb", "depth_m", "T_WC")}
    if ctx.gaussians is not None:
        params = ctx.gaussians.params
        watched |= {f"map {f.name}": getattr(params, f.name) for f in dataclasses.fields(params)}
    before = {name: value.clone() for name, value in watched.items()}
    seeds = apply_rule(rule, _fresh(ctx))
    for name, value in watched.items():
        if not torch.equal(value, before[name]):
            raise AssertionError(f"{where}: it changed {name} in place; work on a copy (x.clone())")
    return seeds


def _check_randomness(rule: SeedingRule, ctx: SeedContext, first: Seeds, where: str) -> None:
    for seed in (1, 2):
        with _other_generators(seed):
            state = _generator_states()
            again = apply_rule(rule, _fresh(ctx))
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
    """Defaults given by name change nothing; switches and choices work in every position."""
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
"""Not Python's ``random``: run-time type checkers draw from it too. A rule that does shows in its result."""


def _generator_states() -> dict[str, Any]:
    return {name: read() for name, read in _STATES.items()}


@contextmanager
def _other_generators(seed: int) -> Iterator[None]:
    """Global random generators set to other states inside the block, and put back behind it."""
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
