"""What a seeding rule is: a function, or a class with a schedule and a memory (``MapRule``).

A rule proposes the Gaussians that are created from one frame. It changes none of its inputs but
``ctx.memory``, and draws random numbers only from ``ctx.generator``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeGuard

from jaxtyping import Bool, Float
from torch import Tensor

from ..checks import check_whole, shown
from ..errors import KindError
from ..gaussians import Edit
from ..types import Camera, Seeds
from .context import SeedContext

NEEDS = {
    "visibility": "``visible`` and ``radius_px``, and how often each Gaussian was visible",
    "image_gradients": "``v_uv``, and the mean length of it for each Gaussian",
    "abs_image_gradients": "``v_uv_abs``, and the mean length of it for each Gaussian",
    "render": "``rgb``",
}
"""What ``MapRule.needs`` may name, and what is then collected; both kinds of gradients include
"visibility"."""


def check_needs(needs: frozenset[str], what: str) -> None:
    """Raise ``TypeError`` for names that ``NEEDS`` does not have; ``what`` begins the sentence."""
    if unknown := sorted(needs - NEEDS.keys(), key=str):
        raise KindError(f"{what} must be among {', '.join(NEEDS)}, got {shown(unknown)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class StepStats:
    """One gradient step, or the last of several if the map is written only after them (RTG-SLAM).

    Values for each Gaussian are those of the map before the step; N is its number of rows, which is
    the same after it. What only ``MapRule.needs`` makes the mapper collect is None without it.
    """

    step: int
    """Number of gradient steps of the map so far, this one included, from 1."""
    stage: Literal["online", "passes"]
    """While scanning, or in the passes over the keyframes after the scan."""
    step_in_frame: int
    """Number of gradient steps for this frame so far, from 1. In the passes after the scan: 1."""
    steps_in_frame: int
    """Number of gradient steps that there will be for this frame. In the passes after the scan:
    1."""
    frame_index: int
    """Index of the frame or keyframe that was rendered and compared; online it may be an earlier
    one than ``ctx.frame``."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Camera and pose that were rendered."""
    target: Float[Tensor, "H W 3"]
    """The measured colours, 0..1."""
    loss: Float[Tensor, ""]
    """Loss before the step, on the device of the map."""
    rgb: Float[Tensor, "H W 3"] | None = None
    """The rendered picture before the step, with "render". Pixels that were not drawn are black
    (RTG-SLAM)."""
    visible: Bool[Tensor, " N"] | None = None
    """Whether each Gaussian reaches into the picture, hidden or not, with "visibility"."""
    radius_px: Float[Tensor, " N"] | None = None
    """Half of the longer side of the box in the picture outside which its alpha is below 1/255,
    pixels, 0 where not visible; with "visibility"."""
    v_uv: Float[Tensor, "N 2"] | None = None
    """dL/d of its centre in the picture, per pixel, with "image_gradients"; 0 where it was not
    optimised."""
    v_uv_abs: Float[Tensor, "N 2"] | None = None
    """The same, but the sum of the absolute values of what each pixel contributes to dL/du and
    dL/dv (Ye et al. 2024, AbsGS), with "abs_image_gradients"."""


@dataclass(frozen=True, kw_only=True)
class When:
    """In which mapped frames a rule is asked: ``EVERY_FRAME``, ``KEYFRAMES``, ``every(n)`` or
    ``submaps(n)``."""

    frames: int = 1
    """The rule is asked in the first mapped frame of this many frames of the recording; counted
    from the start of the submap, if there are submaps. Where only every sixth frame is mapped, a
    rule for every 30 frames is asked in every fifth of them (``seeding.source_stride``)."""
    submap_frames: int = 0
    """Number of frames of the recording in a submap; 0: the whole map is one."""
    only_keyframes: bool = False
    """Only frames that become keyframes."""

    def __post_init__(self):
        check_whole("frames between two calls of a rule", self.frames, 1)
        check_whole("frames of a submap", self.submap_frames, 0)

    def is_due(
        self,
        n_mapped: int,
        is_keyframe: bool | None,
        *,
        stride: int = 1,
    ) -> bool:
        """Whether the rule is asked.

        Args:
            n_mapped: Number of frames that were mapped before this one.
            is_keyframe: Whether this frame becomes a keyframe; None if that depends on its seeds.
            stride: Number of frames of the recording from one mapped frame to the next.
        """
        return self._submap_position(n_mapped, stride) % self.frames < stride and (
            is_keyframe is True or not self.only_keyframes
        )

    def starts_submap(self, n_mapped: int, *, stride: int = 1) -> bool:
        """Whether the frame after ``n_mapped`` others is the first of a submap; ``stride`` as for
        ``is_due``."""
        return self._submap_position(n_mapped, stride) < stride

    def _submap_position(self, n_mapped: int, stride: int) -> int:
        """Position in the recording, counted from the first frame of the submap."""
        position = n_mapped * stride
        return position % self.submap_frames if self.submap_frames else position


EVERY_FRAME = When()
"""The rule is asked in every mapped frame."""

KEYFRAMES = When(only_keyframes=True)
"""The rule is asked in keyframes only. GSFusion must then know them before the rule runs:
``keyframe_every``."""


def every(n: int, *, submap_frames: int = 0) -> When:
    """The rule is asked once in ``n`` frames of the recording, counted anew in each submap of
    ``submap_frames``."""
    return When(frames=n, submap_frames=submap_frames)


def submaps(n: int) -> When:
    """The rule is asked once in each ``n`` frames of the recording, where a submap starts."""
    return When(frames=n, submap_frames=n)


@dataclass(frozen=True, kw_only=True)
class MapRule(ABC):
    """Base of seeding rules that are classes. Use a function where it is enough: it is shorter.

    A rule is a frozen dataclass. It is registered by the name of its class, and its fields are its
    options: numbers, True/False, a word of a ``Literal["...", ...]``, a text, or the ``Path`` of a
    file, each with a default. ::

        @seeding_rule
        @dataclass(frozen=True, kw_only=True)
        class every_fifth(MapRule):
            min_alpha: float = 0.5
            when: ClassVar[When] = every(5)
            overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_xyz": 1e-4}

            def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
                memory["calls"] = memory.get("calls", 0) + 1
                return ctx.seeds_at(ctx.pixels()[:: memory["calls"]], 1.0)

    A rule keeps what it must remember in ``memory``, one dict for each mapper with words as keys:
    tensors, numbers, True/False, words, None, and lists, tuples and dicts of these. It is saved in
    checkpoints. If a frame cannot be mapped, the memory is restored to what it was before that
    frame. A loop closure moves what it says of the world (``move_memory``): the values of a dict
    with the names ``xyz_W`` [N, 3], ``normal_W`` [N, 3] and ``T_WC`` [N, 4, 4], each row with the
    frame of that number in ``frame_index`` [N] in the same dict.
    """

    when: ClassVar[When] = EVERY_FRAME
    """In which frames ``seeds`` is called."""
    needs: ClassVar[frozenset[str]] = frozenset()
    """Statistics of the optimisation that the mapper collects only if a rule asks for them:
    "visibility", "image_gradients", "abs_image_gradients", "render" (``StepStats``). Where they
    depend on the rule's options, override ``statistics``."""
    overrides: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Settings of the system that the rule brings, by name: ``{"optim__lr_xyz": 1e-4}``. The mapper
    applies them when it is made, so they are among the settings that are stored and shown. They
    replace defaults and the choices of a fidelity. The values of a data set's preset and what the
    user sets stay (``seeding.own_settings``). A setting that the system does not have is an error,
    except ``keyframe_every``, which counts frames of the recording here: it is divided by the
    stride."""

    @abstractmethod
    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians that are created from one frame; ``memory`` is ``ctx.memory``."""

    def statistics(self) -> frozenset[str]:
        """What is collected for this rule with its options: words that ``needs`` may have;
        ``needs`` by default."""
        return self.needs

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Changes of the map after a gradient step; None for none. A rule need not have this
        method.

        GSFusion calls it after every gradient step. RTG-SLAM optimises copies of some rows and
        calls it each time after these were written to the map: once after a window, once after a
        keyframe's optimisation, and after every step in the passes after the scan. If it raises
        while a frame is mapped, the whole frame is undone. In the passes the step stays, and the
        edit is not made.

        Args:
            ctx: The frame that is mapped (in the passes: the keyframe, without depth if the mapper
                keeps none), and the map as it is after the step. Numbers for each row of the map
                that move with the row are in ``ctx.gaussians.row_memory("name")``.
            stats: The step.
            memory: The rule's memory, ``ctx.memory``.
        """
        return None


@dataclass(frozen=True, kw_only=True)
class KeyframeRule(MapRule):
    """Base of rules that are asked in keyframes. Every 5th recorded frame is one unless the
    settings say otherwise."""

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}


SeedingRule = Callable[..., Seeds] | type[MapRule]
"""A function ``(ctx, *, option=default, ...) -> Seeds``, or a subclass of ``MapRule``."""

Option = bool | int | float | str | Path
"""A number, True or False, a text, or the path of a file or folder that the rule reads."""


def rule_name(rule: str | SeedingRule) -> str:
    """Name of a rule in messages and reports."""
    return rule if isinstance(rule, str) else getattr(rule, "__name__", type(rule).__name__)


def is_map_rule(rule: SeedingRule) -> TypeGuard[type[MapRule]]:
    """Whether the rule is a class."""
    return isinstance(rule, type) and issubclass(rule, MapRule)
