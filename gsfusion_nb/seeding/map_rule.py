"""Seeding rules as classes: rules with a memory, that say when they are asked and which settings they need."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

from ..checks import check_whole
from ..gaussians import Edit
from ..types import Seeds
from .context import SeedContext
from .step_stats import StepStats


@dataclass(frozen=True, kw_only=True)
class When:
    """In which mapped frames a rule is asked: ``EVERY_FRAME``, ``KEYFRAMES``, ``every(n)`` or ``submaps(n)``."""

    frames: int = 1
    """The rule is asked in the first mapped frame of this many frames of the recording; counted from the start of the
    submap, if there are submaps. Where only every sixth frame is mapped, a rule for every 30 frames is asked in every
    fifth of them (``seeding.source_stride``)."""
    submap_frames: int = 0
    """Number of frames of the recording in a submap; 0: the whole map is one."""
    only_keyframes: bool = False
    """Only frames that become keyframes."""

    def __post_init__(self):
        check_whole("frames between two calls of a rule", self.frames, 1)
        check_whole("frames of a submap", self.submap_frames, 0)

    def is_due(self, n_mapped: int, is_keyframe: bool | None, *, stride: int = 1) -> bool:
        """Whether the rule is asked.

        Args:
            n_mapped: Number of frames that were mapped before this one.
            is_keyframe: Whether this frame becomes a keyframe; None if that depends on its seeds.
            stride: Number of frames of the recording from one mapped frame to the next.
        """
        return self._within(n_mapped, stride) % self.frames < stride and (
            is_keyframe is True or not self.only_keyframes
        )

    def starts_submap(self, n_mapped: int, *, stride: int = 1) -> bool:
        """Whether the frame after ``n_mapped`` others is the first of a submap; ``stride`` as for ``is_due``."""
        return self._within(n_mapped, stride) < stride

    def _within(self, n_mapped: int, stride: int) -> int:
        """Position in the recording, counted from the first frame of the submap."""
        position = n_mapped * stride
        return position % self.submap_frames if self.submap_frames else position


EVERY_FRAME = When()
"""The rule is asked in every mapped frame."""
KEYFRAMES = When(only_keyframes=True)
"""The rule is asked in keyframes only. GSFusion must then know them before the rule runs: ``keyframe_every``."""


def every(n: int, *, submap_frames: int = 0) -> When:
    """The rule is asked once in ``n`` frames of the recording, counted anew in each submap of ``submap_frames``."""
    return When(frames=n, submap_frames=submap_frames)


def submaps(n: int) -> When:
    """The rule is asked once in each ``n`` frames of the recording, where a submap starts."""
    return When(frames=n, submap_frames=n)


@dataclass(frozen=True, kw_only=True)
class MapRule(ABC):
    """Base of seeding rules that are classes. Use a function where it is enough: it is shorter.

    A rule is a frozen dataclass. It is registered by the name of its class, and its fields are its options: numbers,
    True/False, a word of a ``Literal["...", ...]``, a text, or the ``Path`` of a file, each with a default. ::

        @seeding_rule
        @dataclass(frozen=True, kw_only=True)
        class every_fifth(MapRule):
            min_alpha: float = 0.5
            when: ClassVar[When] = every(5)
            overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_xyz": 1e-4}

            def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
                memory["calls"] = memory.get("calls", 0) + 1
                return ctx.seeds_at(ctx.pixels()[:: memory["calls"]], 1.0)

    A rule keeps what it must remember in ``memory``, one dict for each mapper with words as keys: tensors, numbers,
    True/False, words, None, and lists, tuples and dicts of these. It is saved in checkpoints. If a frame cannot be
    mapped, the memory is restored to what it was before that frame. A loop closure moves what it says of the world
    (``move_memory``): the values of a dict with the names ``xyz_W`` [N, 3], ``normal_W`` [N, 3] and ``T_WC`` [N, 4, 4],
    each row with the frame of that number in ``frame_index`` [N] in the same dict.
    """

    when: ClassVar[When] = EVERY_FRAME
    """In which frames ``seeds`` is called."""
    needs: ClassVar[frozenset[str]] = frozenset()
    """Statistics of the optimisation that the mapper collects only if a rule asks for them: "visibility",
    "image_gradients", "abs_image_gradients", "render" (``StepStats``). Where they depend on the rule's options,
    override ``statistics``."""
    overrides: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Settings of the system that the rule brings, by name: ``{"optim__lr_xyz": 1e-4}``. The mapper applies them when
    it is made, so they are among the settings that are stored and shown. They replace defaults and the values of the
    presets "room" and "replica". Any other value stays, because the user has chosen it, and so does every setting that
    ``seeding.own_settings`` names. A setting that the system does not have is an error, except ``keyframe_every``,
    which counts frames of the recording here: it is divided by the stride."""

    @abstractmethod
    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians that are created from one frame; ``memory`` is ``ctx.memory``."""

    def statistics(self) -> frozenset[str]:
        """What is collected for this rule with its options: words that ``needs`` may have; ``needs`` by default."""
        return self.needs

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Changes of the map after a gradient step; None for none. A rule need not have this method.

        GSFusion calls it after every gradient step. RTG-SLAM optimises copies of some rows and calls it each time after
        these were written to the map: once after a window, once after a keyframe's optimisation, and after every step
        in the passes after the scan. If it raises while a frame is mapped, the whole frame is undone. In the passes the
        step stays, and the edit is not made.

        Args:
            ctx: The frame that is mapped (in the passes: the keyframe, without depth if the mapper keeps none), and the
                map as it is after the step. Numbers for each row of the map that move with the row are in
                ``ctx.gaussians.row_memory("name")``.
            stats: The step.
            memory: The rule's memory, ``ctx.memory``.
        """
        return None
