"""How a mapper calls its seeding rule: what it sees, when it is asked, and what it proposes."""

from typing import Any

from ..errors import ArgumentError
from ..render.near_plane import near_plane_m
from ..seeding import MapReading, SeedContext, apply_rule, rule_name
from ..seeding.input_guard import ChangedInputError
from ..types import Frame, Seeds


def context_of(mapper: Any, frame: Frame, **inputs: Any) -> SeedContext:
    """A context with what every system gives a rule.

    Args:
        mapper: The ``Mapper``.
        frame: The frame that is mapped.
        inputs: What the system gives besides.
    """
    in_use = mapper.rule_in_use
    config = mapper.config
    return SeedContext(
        frame,
        gaussians=mapper.gaussians,
        reading=MapReading(
            boxes=mapper.parts.boxes,
            params=mapper.parts.params_now,
            all_in_view=config.all_in_view,
            near_plane_m=near_plane_m(config),
        ),
        generator=mapper.random.rule,
        config=config.seeding,
        memory=in_use.memory,
        starts_submap=in_use.when.starts_submap(mapper.n_frames, stride=config.source_stride),
        keyframes=tuple(mapper.keyframes),
        past_T_WC=tuple(mapper.trajectory.poses),
        **inputs,
    )


def rule_is_due(mapper: Any, is_keyframe: bool | None) -> bool:
    """Whether the rule is asked in the frame that is mapped next (``MapRule.when``)."""
    when = mapper.rule_in_use.when
    return when.is_due(mapper.n_frames, is_keyframe, stride=mapper.config.source_stride)


def ask_rule(mapper: Any, context: SeedContext, **checks: Any) -> Seeds:
    """Ask the seeding rule for new Gaussians; there are none in a frame in which it is not due.

    Args:
        mapper: The ``Mapper``.
        context: What the rule sees.
        checks: Further arguments of ``apply_rule``.

    Raises:
        ValueError: the rule is asked in keyframes only, and the system chooses them by the seeds.
        Exception: what the rule raises.
    """
    in_use = mapper.rule_in_use
    is_keyframe = None
    if in_use.when.only_keyframes:
        is_keyframe = mapper.is_next_keyframe(context.frame)  # may wait for a GPU
        if is_keyframe is None:
            raise ArgumentError(
                f"the seeding rule {rule_name(mapper.rule)!r} is asked in keyframes only, but "
                f"{mapper.description.title} chooses its keyframes after the seeding"
            )
    if not rule_is_due(mapper, is_keyframe):
        return Seeds.empty(context.frame.depth_m)
    try:
        with in_use.call_context():
            return apply_rule(in_use.bound, context, **checks)
    except ChangedInputError as e:
        if not e.what.startswith("frame."):  # which is as it was
            mapper.guard.half_mapped = (
                f"the map was changed by its seeding rule {rule_name(mapper.rule)!r} ({e.what})"
            )
        raise
