"""How a mapper asks its seeding rule for new Gaussians."""

from typing import Any, ClassVar

from ..optim import KeyframeList
from ..seeding import SeedContext, SeedingRule, apply_rule, rule_name
from ..types import Frame, Seeds
from .localiser import Localiser
from .random_streams import RandomStreams
from .rule_in_use import RuleInUse


class AsksRule:
    """The part of every mapper that deals with its rule: what the rule sees, and whether it is due.

    ``Mapper`` sets the attributes.
    """

    title: ClassVar[str]
    config: Any
    gaussians: Any
    rule: SeedingRule
    rule_in_use: RuleInUse
    random: RandomStreams
    keyframes: KeyframeList
    localiser: Localiser
    n_frames: int

    @property
    def memory(self) -> dict[str, Any]:
        """What the seeding rule keeps from one frame to the next."""
        return self.rule_in_use.memory

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame."""
        return self._context(frame)

    def _context(self, frame: Frame, **more: Any) -> SeedContext:
        """A context with what every system gives a rule, and ``more`` of this one."""
        return SeedContext(
            frame,
            gaussians=self.gaussians,
            generator=self.random.rule,
            config=self.config.seeding,
            memory=self.memory,
            starts_submap=self.rule_in_use.when.starts_submap(self.n_frames, stride=self.config.source_stride),
            keyframes=tuple(self.keyframes),
            past_T_WC=tuple(self.localiser.poses),
            **more,
        )

    def propose_seeds(self, context: SeedContext, **checks: Any) -> Seeds:
        """Ask the seeding rule for new Gaussians; there are none in a frame in which it is not due (``MapRule.when``).

        Args:
            context: What the rule sees.
            checks: Further arguments of ``apply_rule``.
        """
        when = self.rule_in_use.when
        is_keyframe = self.is_next_keyframe(context.frame) if when.only_keyframes else None  # may wait for a GPU
        if when.only_keyframes and is_keyframe is None:
            raise ValueError(
                f"the seeding rule {rule_name(self.rule)!r} is asked in keyframes only, but {self.title} chooses its "
                "keyframes after the seeding"
            )
        if not self.rule_is_due(is_keyframe):
            return Seeds.empty(context.frame.depth_m)
        with self.rule_in_use.running():
            return apply_rule(self.rule, context, self.config.seeding.options, **checks)

    def rule_is_due(self, is_keyframe: bool | None) -> bool:
        """Whether the rule is asked in the frame that is mapped next (``MapRule.when``)."""
        return self.rule_in_use.when.is_due(self.n_frames, is_keyframe, stride=self.config.source_stride)

    def is_next_keyframe(self, frame: Frame) -> bool | None:
        """Whether this frame, mapped next, becomes a keyframe; None if that depends on its seeds."""
        return None
