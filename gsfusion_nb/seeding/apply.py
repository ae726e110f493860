"""Running a seeding rule: it leaves its inputs unchanged, keeps only what can be saved, and returns valid seeds."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import observed
from ..checks import check_finite, check_shape, shown
from ..geometry.operands import MAX_DISTANCE_M
from ..types import Seeds, rgb_of_bytes
from .context import SeedContext
from .rule import Option, SeedingRule, get_rule, is_map_rule, option_values, rule_name

_PLAIN = (type(None), bool, int, float, str)
_RESERVED = "$"
"""Checkpoints use this key themselves."""
_WORLD = {"xyz_W": (3,), "normal_W": (3,), "T_WC": (4, 4)}
"""Names of values in world coordinates, and the shape of a row: points, directions, camera-to-world poses."""


def check_memory(rule: str, memory: Any, name: str = "memory") -> None:
    """Raise ``TypeError``, with the place, unless ``memory`` holds only what a checkpoint can save.

    Args:
        rule: Name of the rule, for the message.
        memory: A dict with strings as keys; tensors, None, True/False, numbers, words, and lists, tuples and dicts of
            these.
        name: What it is called in the message.
    """
    if type(memory) is dict:
        for key, value in memory.items():
            if type(key) is not str or key == _RESERVED:
                raise TypeError(f"seeding rule {rule!r}: the keys of its {name} must be words, got {shown(key)}")
            check_memory(rule, value, f"{name}[{key!r}]")
        _check_world(rule, memory, name)
    elif type(memory) in (list, tuple):
        for i, value in enumerate(memory):
            check_memory(rule, value, f"{name}[{i}]")
    elif not isinstance(memory, Tensor) and type(memory) not in _PLAIN:
        raise TypeError(
            f"seeding rule {rule!r} keeps a {type(memory).__name__} in its {name}, which a checkpoint cannot save; "
            "expected tensors, numbers, True/False, words, None, and lists, tuples and dicts of these"
        )


def copy_memory(memory: Any) -> Any:
    """A copy that shares nothing with ``memory``."""
    if isinstance(memory, Tensor):
        return memory.clone()
    if isinstance(memory, dict):
        return {key: copy_memory(value) for key, value in memory.items()}
    if isinstance(memory, (list, tuple)):
        return type(memory)(copy_memory(value) for value in memory)
    return memory


def equal_memories(a: Any, b: Any) -> bool:
    """Whether two memories hold the same values, bit for bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal_memories(value, b[key]) for key, value in a.items())
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal_memories, a, b))
    return a == b or (a != a and b != b)


def describe_memory(memory: dict[str, Any]) -> str:
    """The names in a memory and the size of each: "occupied 1,024 x 3 int64, calls 12"; "empty" without any."""
    return ", ".join(f"{name} {_size(value)}" for name, value in memory.items()) or "empty"


def _size(value: Any) -> str:
    if isinstance(value, Tensor):
        sides = " x ".join(f"{side:,}" for side in value.shape)
        return " ".join(filter(None, (sides, str(value.dtype).removeprefix("torch."))))
    if isinstance(value, (dict, list, tuple)):
        return f"({len(value):,} values)"
    return shown(value)


def move_memory(memory: Any, transform_of: Callable[[Int[Tensor, " N"]], Float[Tensor, "N 4 4"]]) -> None:
    """Move the values in world coordinates with the map, in place, as a loop closure moves Gaussians and keyframes.

    Args:
        memory: What a rule keeps. In each dict in it, the values with the names ``xyz_W`` (points), ``normal_W``
            (directions) and ``T_WC`` (poses) are moved, each row with the frame that ``frame_index`` says.
        transform_of: Frames -> world-to-world motions (``Correction.transform_of``).
    """
    if not isinstance(memory, (dict, list, tuple)):
        return
    if isinstance(memory, dict) and (names := _WORLD.keys() & memory.keys()):
        T = transform_of(memory["frame_index"])
        for name in names:
            value = memory[name]
            turn = T.to(value)
            if name == "T_WC":
                memory[name] = turn @ value
            else:
                turned = (turn[:, :3, :3] @ value[:, :, None]).squeeze(2)
                memory[name] = turned + turn[:, :3, 3] if name == "xyz_W" else turned
    for value in memory.values() if isinstance(memory, dict) else memory:
        move_memory(value, transform_of)


def _check_world(rule: str, memory: dict[str, Any], name: str) -> None:
    """Raise ``TypeError`` for values in world coordinates without the frame of each row, by which they are moved."""
    for key in _WORLD.keys() & memory.keys():
        value, frame = memory[key], memory.get("frame_index")
        rows = len(frame) if isinstance(frame, Tensor) and frame.dtype == torch.int64 and frame.ndim == 1 else -1
        is_float = isinstance(value, Tensor) and value.is_floating_point()
        if not is_float or tuple(value.shape) != (rows, *_WORLD[key]):
            raise TypeError(
                f"seeding rule {rule!r}: {name}[{key!r}] is moved when a loop closes, so it must be a floating-point "
                f"tensor [N, {', '.join(map(str, _WORLD[key]))}] beside {name}['frame_index'], an int64 tensor [N] "
                f"with ctx.frame.index for each row; got {_size(value)} and {_size(frame)}"
            )


_COLUMNS = {"xyz_W": ("N", 3), "rgb": ("N", 3), "scale_m": ("N", 3), "quat": ("N", 4), "opacity": ("N",), "tag": ("N",)}


@observed
def apply_rule(
    rule: str | SeedingRule, ctx: SeedContext, options: Mapping[str, Option] | None = None, one_per_voxel: bool = False
) -> Seeds:
    """Run a rule on one frame and check what it returns.

    Args:
        rule: Name, function or class.
        ctx: What the rule may look at, and its memory.
        options: Values of the rule's options, in place of its defaults.
        one_per_voxel: Afterwards keep at most one seed per voxel, and none in voxels that hold a Gaussian.

    Returns:
        The new Gaussians, on the frame's device.

    Raises:
        KeyError: no such rule. TypeError: unknown option, wrong type of option or of result, or something in the
            rule's memory that cannot be saved.
        ValueError: a column of wrong shape, NaN, scale <= 0, opacity outside (0, 1), colour outside 0..1, or an
            implausibly large position or scale. ChangedInputError: the rule changed the frame or the map in place.
    """
    found = get_rule(rule)
    values: Any = option_values(found, options or {})
    versions = Versions(ctx)
    if is_map_rule(found):
        seeds = found(**values).seeds(ctx, ctx.memory)
    else:
        seeds = cast(Callable[..., Seeds], found)(ctx, **values)
    check_memory(rule_name(rule), ctx.memory)
    if changed := versions.changed():
        raise ChangedInputError(rule_name(rule), changed)
    try:
        _check_seeds(seeds, ctx)
    except (TypeError, ValueError) as error:
        raise type(error)(f"seeding rule {rule_name(rule)!r} returned invalid seeds: {error}") from None
    if not one_per_voxel:
        return seeds
    taken = None if ctx.gaussians is None else ctx.voxel_index(ctx.gaussians.params.xyz_W)
    return keep_one_per_voxel(seeds, ctx.voxel_index(seeds.xyz_W), taken)


def keep_one_per_voxel(seeds: Seeds, voxel: Int[Tensor, "N 3"], taken: Int[Tensor, "M 3"] | None = None) -> Seeds:
    """Of the seeds that share a voxel, keep the one with the largest standard deviation; of equal ones the first.

    The largest one best covers the area of the seeds that are dropped. GSFusion IV-C.1 says that a voxel contains at
    most one Gaussian, but not which one.

    Args:
        seeds: Proposed Gaussians, N rows.
        voxel: Integer voxel coordinates of each. [N, 3]
        taken: Voxels that hold a Gaussian of the map; no seed in them is kept. [M, 3]

    Returns:
        The seeds that are kept, in their order.
    """
    if taken is not None and len(taken) and len(seeds):
        _, group = torch.unique(torch.cat([voxel, taken]), dim=0, return_inverse=True)
        free = ~torch.isin(group[: len(seeds)], group[len(seeds) :])
        seeds, voxel = seeds[free], voxel[free]
    if len(seeds) == 0:
        return seeds
    size = seeds.scale_m.amax(dim=-1)
    order = size.argsort(descending=True, stable=True)
    _, group = torch.unique(voxel[order], dim=0, return_inverse=True)
    rank = torch.arange(len(seeds), device=group.device)
    best = torch.full_like(rank, len(seeds)).scatter_reduce_(0, group, rank, "amin")
    return seeds[order[best[best < len(seeds)]].sort().values]


def _is_plausible(seeds: Seeds) -> bool:
    """Whether all values are finite and within the limits of ``_check_seeds``. A GPU is waited for once."""
    columns = [getattr(seeds, name) for name in _COLUMNS if name != "tag"]
    extremes = [extreme for column in (*columns, seeds.quat.norm(dim=-1)) for extreme in torch.aminmax(column)]
    values = torch.stack(extremes).tolist()  # those of a NaN are NaN
    xyz, rgb, scale_m, _, opacity, length = zip(values[::2], values[1::2], strict=True)
    return (
        all(map(math.isfinite, values))
        and max(-xyz[0], xyz[1]) <= MAX_DISTANCE_M
        and 0 <= rgb[0] <= rgb[1] <= 1
        and 0 < scale_m[0] <= scale_m[1] < MAX_DISTANCE_M
        and 0 < opacity[0] <= opacity[1] < 1
        and length[0] > 1e-6
    )


def _check_seeds(seeds: Any, ctx: SeedContext) -> None:
    if not isinstance(seeds, Seeds):
        hint = " (is there a return?)" if seeds is None else ""
        raise TypeError(f"expected Seeds, got {type(seeds).__name__}{hint}")
    n = len(seeds)
    for name, shape in _COLUMNS.items():
        column = getattr(seeds, name)
        check_shape(name, column, (n, *shape[1:]))
        if column.device != ctx.frame.depth_m.device:
            raise ValueError(f"{name} must be on the frame's device {ctx.frame.depth_m.device}, got {column.device}")
        if name != "tag" and not column.is_floating_point():
            raise ValueError(f"{name} must be floating point, got {column.dtype}")
    if n == 0 or _is_plausible(seeds):
        return
    length = seeds.quat.norm(dim=-1)
    far = f"{MAX_DISTANCE_M:,.0f} m"
    limits = (
        (f"xyz_W must be within {far} of the origin", seeds.xyz_W, seeds.xyz_W.abs() <= MAX_DISTANCE_M),
        (f"scale_m must be below {far}", seeds.scale_m, seeds.scale_m < MAX_DISTANCE_M),
        ("scale_m must be > 0", seeds.scale_m, seeds.scale_m > 0),
        ("opacity must lie strictly between 0 and 1", seeds.opacity, (seeds.opacity > 0) & (seeds.opacity < 1)),
        ("rgb must lie in 0..1", seeds.rgb, (seeds.rgb >= 0) & (seeds.rgb <= 1)),
        ("quat must not be zero", length, length > 1e-6),
    )
    for name in _COLUMNS:
        if name != "tag":
            check_finite(name, getattr(seeds, name))
    for rule, values, ok in limits:
        if not ok.all():
            bad = values[~ok]
            row = int((~ok).nonzero()[0, 0])
            raise ValueError(
                f"{rule}, got {len(bad)} other values, from {float(bad.min()):g} to {float(bad.max()):g}, the first of "
                f"them in row {row}"
            )


class ChangedInputError(RuntimeError):
    """A seeding rule changed the frame or the map in place.

    Args:
        rule: Name of the rule.
        what: Which tensors.
    """

    def __init__(self, rule: str, what: list[str]):
        super().__init__(
            f"seeding rule {rule!r} changed {' and '.join(what)} in place; a rule must leave its inputs unchanged: "
            "work on a copy (x.clone())"
        )
        self.what = " and ".join(what)
        self.changed_map = any(not name.startswith("frame.") for name in what)


class Versions:
    """torch's version counters of a context's tensors at one time.

    Writes through ``numpy()`` are not counted; ``check_rule`` finds those.
    """

    def __init__(self, context: SeedContext):
        self._frame = context.frame
        self._tensors = [(name, tensor, _version(tensor)) for name, tensor in context_tensors(context)]

    def changed(self) -> list[str]:
        """Names of the tensors that have been changed since."""
        names = [name for name, tensor, version in self._tensors if _version(tensor) != version]
        made = vars(self._frame).get("rgb")  # floats that the rule was the first to ask for
        if made is not None and all(made is not tensor for _, tensor, _ in self._tensors):
            names += ["frame.rgb"] * (_version(made) != _version(rgb_of_bytes(self._frame.colour[:1, :1])))
        return names


def context_tensors(context: SeedContext) -> Iterator[tuple[str, Tensor]]:
    """Name and tensor of everything that a rule can read in a context: frame, Gaussians, keyframes, poses, volume."""
    frame = context.frame
    yield "frame.rgb_u8" if frame.is_8_bit else "frame.rgb", frame.colour
    yield from ((f"frame.{name}", getattr(frame, name)) for name in ("depth_m", "T_WC"))
    if (rgb := vars(frame).get("rgb")) is not None and rgb is not frame.colour:
        yield "frame.rgb", rgb
    yield from ((f"frame.extra[{name!r}]", image) for name, image in frame.extra.items())
    if context.gaussians is not None:
        params = context.gaussians.params
        yield from ((f"map.{f.name}", getattr(params, f.name)) for f in dataclasses.fields(params))
        for name in ("tag", "state"):
            if isinstance(column := getattr(context.gaussians, name, None), Tensor):
                yield f"map.{name}", column
    for i, keyframe in enumerate(context.keyframes):
        for name in ("rgb_u8", "depth_m", "T_WC"):
            if isinstance(value := getattr(keyframe, name, None), Tensor):
                yield f"keyframes[{i}].{name}", value
    yield from (("past_T_WC", T_WC) for T_WC in context.past_T_WC[-1:])  # a mapper's poses share one counter
    for name in ("D", "W", "rgb"):
        if isinstance(values := getattr(context.volume, name, None), Tensor):
            yield f"volume.{name}", values


def _version(tensor: Tensor) -> int:
    return 0 if tensor.is_inference() else tensor._version
