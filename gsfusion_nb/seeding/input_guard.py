"""A seeding rule leaves unchanged what it is given to read."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from ..edit_count import edit_count, is_counted
from ..errors import ForeseenError
from .bound_rule import BoundRule
from .context import SeedContext
from .read_only import read_only


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
    ctx: SeedContext, rule: BoundRule, *, is_quick: bool = False
) -> Iterator[None]:
    """Context in which a rule may change its memory, but nothing else of what it was given.

    A rule that is not watched is only called. A change of the frame is undone. Of the Gaussians and
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
    if not rule.is_watched:
        yield
        return
    _ = ctx.frame.rgb  # made now, so that it is among them
    tensors = list(context_tensors(ctx))
    counts = [edit_count(tensor) for _, tensor in tensors]
    copies = {
        name: tensor.clone()
        for name, tensor in tensors
        if name.startswith("frame.") and not is_quick
    }
    sums = {
        name: _sum_of_bits(tensor)
        for name, tensor in tensors
        if (name.startswith("map.") and not is_quick) or not is_counted(tensor)
    }
    places = [_place(tensor) for _, tensor in tensors]
    changed_name = ""
    try:
        with read_only(
            (name, x) for name, x in tensors if name not in copies and name not in sums
        ) as array_names:
            yield
    except Exception as e:
        # NumPy's word, and OpenCV's
        if array_names and ("read-only" in str(e) or "readonly" in str(e)):
            raise ChangedInputError(rule.name, array_names[-1]) from e
        raise
    finally:
        for (name, tensor), count in zip(tensors, counts, strict=True):
            is_same = not is_counted(tensor) or edit_count(tensor) == count
            if name in copies and not _same_bits(tensor, copies[name]):
                is_same = False
                tensor.copy_(copies[name])
            if name in sums and _sum_of_bits(tensor) != sums[name]:
                is_same = False
            if not is_same:
                changed_name = changed_name or name
        new_tensors = dict(context_tensors(ctx))
        for (name, _), place in zip(tensors, places, strict=True):
            if name not in new_tensors or _place(new_tensors[name]) != place:
                changed_name = changed_name or name
        changed_name = changed_name or next(
            (name for name in new_tensors if name not in dict(tensors)), ""
        )
    if changed_name:
        raise ChangedInputError(rule.name, changed_name)


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
    """A number that a changed_name of any value changes."""
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
