"""Whether a seeding rule leaves its inputs unchanged, by torch's version counters, which costs almost no time."""

import dataclasses
from collections.abc import Iterator

from torch import Tensor

from ..types import rgb_of_bytes
from .context import SeedContext


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
