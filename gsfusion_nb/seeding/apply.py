"""Running a seeding rule: it leaves its inputs unchanged, keeps only what can be saved, and returns
valid seeds."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import observed
from ..checks import check_finite, check_shape, shown
from ..errors import ArgumentError, ForeseenError, KindError
from ..geometry.operands import MAX_DISTANCE_M
from ..types import Seeds
from .context import SeedContext
from .map_queries import map_params
from .read_only import read_only
from .rule import Option, SeedingRule, get_rule, is_map_rule, option_values, rule_name
from .rule_code import is_built_in
from .volume_queries import voxel_index

_PLAIN = (type(None), bool, int, float, str)
_RESERVED = "$"
"""Checkpoints use this key themselves."""
_WORLD = {"xyz_W": (3,), "normal_W": (3,), "T_WC": (4, 4)}
"""Names of values in world coordinates, and the shape of a row: points, directions, camera-to-world
poses."""


def check_memory(rule: str, memory: Any, name: str = "memory") -> None:
    """Raise ``TypeError``, with the place, unless ``memory`` holds only what a checkpoint can save.

    Args:
        rule: Name of the rule, for the message.
        memory: A dict with strings as keys; tensors, None, True/False, numbers, words, and lists,
            tuples and dicts of these.
        name: What it is called in the message.
    """
    if type(memory) is dict:
        for key, value in memory.items():
            if type(key) is not str or key == _RESERVED:
                raise KindError(
                    f"seeding rule {rule!r}: the keys of its {name} must be words, got {shown(key)}"
                )
            check_memory(rule, value, f"{name}[{key!r}]")
        _check_world(rule, memory, name)
    elif type(memory) in (list, tuple):
        for i, value in enumerate(memory):
            check_memory(rule, value, f"{name}[{i}]")
    elif not isinstance(memory, Tensor) and type(memory) not in _PLAIN:
        raise KindError(
            f"seeding rule {rule!r} keeps a {type(memory).__name__} in its {name}, which a "
            "checkpoint cannot save; expected tensors, numbers, True/False, words, None, and "
            "lists, tuples and dicts of these"
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
        return a.keys() == b.keys() and all(
            equal_memories(value, b[key]) for key, value in a.items()
        )
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal_memories, a, b))
    return a == b or (a != a and b != b)


def move_memory(
    memory: Any, transform_of: Callable[[Int[Tensor, " N"]], Float[Tensor, "N 4 4"]]
) -> None:
    """Move the values in world coordinates with the map, in place, as a loop closure moves
    Gaussians and keyframes.

    Args:
        memory: What a rule keeps. In each dict in it, the values with the names ``xyz_W`` (points),
            ``normal_W`` (directions) and ``T_WC`` (poses) are moved, each row with the frame that
            ``frame_index`` says.
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
    """Raise ``TypeError`` for values in world coordinates without the frame of each row, by which
    they are moved."""
    for key in _WORLD.keys() & memory.keys():
        value = memory[key]
        frame = memory.get("frame_index")
        n = (
            len(frame)
            if isinstance(frame, Tensor) and frame.ndim == 1 and not frame.is_floating_point()
            else -1
        )
        if not isinstance(value, Tensor) or tuple(value.shape) != (n, *_WORLD[key]):
            raise KindError(
                f"seeding rule {rule!r}: {name}[{key!r}] is moved when a loop closes, so it must "
                f"be a tensor [N, {', '.join(map(str, _WORLD[key]))}] beside "
                f"{name}['frame_index'], an int64 tensor [N] with ctx.frame.index for each row"
            )


_COLUMNS = {
    "xyz_W": ("N", 3),
    "rgb": ("N", 3),
    "scale_m": ("N", 3),
    "quat": ("N", 4),
    "opacity": ("N",),
    "tag": ("N",),
}


@observed
def apply_rule(
    rule: str | SeedingRule,
    ctx: SeedContext,
    options: Mapping[str, Option] | None = None,
    one_per_voxel: bool = False,
) -> Seeds:
    """Run a rule on one frame and check what it returns.

    Args:
        rule: Name, function or class.
        ctx: What the rule may look at, and its memory.
        options: Values of the rule's options, in place of its defaults.
        one_per_voxel: Afterwards keep at most one seed per voxel, and none in voxels that hold a
            Gaussian.

    Returns:
        The new Gaussians, on the frame's device.

    Raises:
        KeyError: no such rule. TypeError: unknown option, wrong type of option or of result, or
            something in the rule's memory that cannot be saved.
        ValueError: a column of wrong shape, NaN, scale <= 0, opacity outside (0, 1), colour outside
            0..1, or an implausibly large position or scale; or the rule changed what it was given
            to read.
    """
    found = get_rule(rule)
    values: Any = option_values(found, options or {})
    with unchanged_inputs(ctx, found):
        if is_map_rule(found):
            seeds = found(**values).seeds(ctx, ctx.memory)
        else:
            seeds = cast(Callable[..., Seeds], found)(ctx, **values)
    check_memory(rule_name(rule), ctx.memory)
    try:
        _check_seeds(seeds, ctx)
    except (TypeError, ValueError) as error:
        raise type(error)(
            f"seeding rule {rule_name(rule)!r} returned invalid seeds: {error}"
        ) from None
    if not one_per_voxel:
        return seeds
    taken = None if ctx.gaussians is None else voxel_index(ctx, map_params(ctx).xyz_W)
    return keep_one_per_voxel(seeds, voxel_index(ctx, seeds.xyz_W), taken)


def keep_one_per_voxel(
    seeds: Seeds,
    voxel: Int[Tensor, "N 3"],
    taken: Int[Tensor, "M 3"] | None = None,
) -> Seeds:
    """Of the seeds that share a voxel, keep the one with the largest standard deviation; of equal
    ones the first.

    The largest one best covers the area of the seeds that are dropped. GSFusion IV-C.1 says that a
    voxel contains at most one Gaussian, but not which one.

    Args:
        seeds: Proposed Gaussians, N rows.
        voxel: Integer voxel coordinates of each. [N, 3]
        taken: Voxels that hold a Gaussian of the map; no seed in them is kept. [M, 3]

    Returns:
        The seeds that are kept, in their order.
    """
    if taken is not None and len(taken) and len(seeds):
        _, group = torch.unique(
            torch.cat([voxel, taken]),
            dim=0,
            return_inverse=True,
        )
        free = ~torch.isin(group[: len(seeds)], group[len(seeds) :])
        seeds = seeds[free]
        voxel = voxel[free]
    if len(seeds) == 0:
        return seeds
    size = seeds.scale_m.amax(dim=-1)
    order = size.argsort(descending=True, stable=True)
    _, group = torch.unique(voxel[order], dim=0, return_inverse=True)
    rank = torch.arange(len(seeds), device=group.device)
    best = torch.full_like(rank, len(seeds)).scatter_reduce_(0, group, rank, "amin")
    return seeds[order[best[best < len(seeds)]].sort().values]


def _check_seeds(seeds: Any, ctx: SeedContext) -> None:
    if not isinstance(seeds, Seeds):
        hint = " (is there a return?)" if seeds is None else ""
        raise KindError(f"expected Seeds, got {type(seeds).__name__}{hint}")
    n = len(seeds)
    for name, shape in _COLUMNS.items():
        column = getattr(seeds, name)
        check_shape(name, column, (n, *shape[1:]))
        if column.device != ctx.frame.depth_m.device:
            raise ArgumentError(
                f"{name} must be on the frame's device {ctx.frame.depth_m.device}, got "
                f"{column.device}"
            )
        if name != "tag" and not column.is_floating_point():
            raise ArgumentError(f"{name} must be floating point, got {column.dtype}")
    if n == 0:
        return
    far = f"{MAX_DISTANCE_M:,.0f} m"
    columns = {name: getattr(seeds, name) for name in _COLUMNS if name != "tag"}
    columns["length of quat"] = seeds.quat.norm(dim=-1)
    extremes = torch.stack([x for column in columns.values() for x in torch.aminmax(column)])
    values = extremes.tolist()  # a GPU is waited for once; the extremes of a NaN are NaN
    found = dict(
        zip(
            columns,
            zip(values[::2], values[1::2], strict=True),
            strict=True,
        )
    )
    for name, (low, high) in found.items():
        if not (math.isfinite(low) and math.isfinite(high)):
            check_finite(name, columns[name])
        wanted, fits = {
            "xyz_W": (f"within {far} of the origin", max(-low, high) <= MAX_DISTANCE_M),
            "rgb": ("in 0..1", low >= 0 and high <= 1),
            "scale_m": (f"above 0 and below {far}", low > 0 and high < MAX_DISTANCE_M),
            "opacity": ("strictly between 0 and 1", low > 0 and high < 1),
            "length of quat": ("above 0", low > 1e-6),
        }.get(name, ("", True))
        if not fits:
            raise ArgumentError(f"{name} must be {wanted}, got {low:g} to {high:g}")


class ChangedInputError(ForeseenError, ValueError):
    """A rule changed something in place that it may only read; ``what`` names it."""

    def __init__(self, rule: str, what: str):
        super().__init__(
            f"seeding rule {rule!r} changed {what} in place, which the map and other rules use "
            "too; work on a copy (x.clone())"
        )
        self.what = what


@contextmanager
def unchanged_inputs(
    ctx: SeedContext, rule: SeedingRule, *, is_quick: bool = False
) -> Iterator[None]:
    """Context in which a rule may change its memory, but nothing else of what it was given.

    The rules of this package are not watched. A change of the frame is undone. Of the Gaussians and
    the frame every change is seen, of the rest those that torch makes; NumPy's arrays of the rest
    cannot be written to.

    Args:
        ctx: What the rule sees.
        rule: The rule.
        is_quick: Only changes that torch makes are looked for, everywhere, and no array can be
            written to; for calls after each gradient step.

    Raises:
        ChangedInputError: at the end of the context, if the rule changed one of them in place.
    """
    if is_built_in(rule):
        yield
        return
    _ = ctx.frame.rgb  # made now, so that it is among them
    watched = list(context_tensors(ctx))
    versions = [_version(tensor) for _, tensor in watched]
    copies = {
        name: tensor.clone()
        for name, tensor in watched
        if name.startswith("frame.") and not is_quick
    }
    sums = {
        name: _sum_of_bits(tensor)
        for name, tensor in watched
        if name.startswith("map.") and not is_quick
    }
    places = [_place(tensor) for _, tensor in watched]
    changed = ""
    try:
        with read_only(
            (name, x) for name, x in watched if name not in copies and name not in sums
        ) as made:
            yield
    except Exception as e:
        if made and ("read-only" in str(e) or "readonly" in str(e)):  # NumPy's word, and OpenCV's
            raise ChangedInputError(rule_name(rule), made[-1]) from e
        raise
    finally:
        for (name, tensor), version in zip(watched, versions, strict=True):
            is_same = _version(tensor) == version
            if name in copies and not _same_bits(tensor, copies[name]):
                is_same = False
                tensor.copy_(copies[name])
            if name in sums and _sum_of_bits(tensor) != sums[name]:
                is_same = False
            if not is_same:
                changed = changed or name
        after = dict(context_tensors(ctx))
        for (name, _), place in zip(watched, places, strict=True):
            if name not in after or _place(after[name]) != place:
                changed = changed or name
        changed = changed or next((name for name in after if name not in dict(watched)), "")
    if changed:
        raise ChangedInputError(rule_name(rule), changed)


def _version(tensor: Tensor) -> int:
    """Number of changes in place that torch made to a tensor, or to what it is a view of."""
    return 0 if tensor.is_inference() else tensor._version


def _place(tensor: Tensor) -> tuple[int, torch.Size, torch.dtype]:
    """Where a tensor is in memory. Another one in its place is another tensor."""
    return tensor.data_ptr(), tensor.shape, tensor.dtype


def _same_bits(a: Tensor, b: Tensor) -> bool:
    return torch.equal(_bits(a), _bits(b))


def _bits(tensor: Tensor) -> Tensor:
    """Floats as whole numbers, so that NaN equals itself."""
    kinds = {torch.float32: torch.int32, torch.float64: torch.int64, torch.float16: torch.int16}
    return tensor.view(kinds[tensor.dtype]) if tensor.dtype in kinds else tensor


def _sum_of_bits(tensor: Tensor) -> int:
    """A number that a change of any value changes."""
    bits = _bits(tensor.detach()).flatten(1) if tensor.ndim > 1 else _bits(tensor.detach())[:, None]
    weights = torch.arange(1, bits.shape[1] + 1, device=bits.device)
    return int((bits.sum(dim=0) * weights).sum())


def context_tensors(context: SeedContext) -> Iterator[tuple[str, Tensor]]:
    """Name and tensor of everything that a rule can read in a context: frame, Gaussians, keyframes,
    poses, volume."""
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
    # a mapper's poses share one counter
    yield from (("past_T_WC", T_WC) for T_WC in context.past_T_WC[-1:])
    volume = getattr(context.volume, "_volume", context.volume)
    for name in ("D", "W", "rgb"):
        if isinstance(values := getattr(volume, name, None), Tensor):
            yield f"volume.{name}", values
