"""Seeding rules by name: ``@seeding_rule`` registers a function or class; a mapper takes its name,
or the rule itself.

A rule is a function ``(ctx: SeedContext, *, number=default, ...) -> Seeds``, or a class
(``MapRule``). It proposes the Gaussians that are created from one frame. It changes none of its
inputs but ``ctx.memory``, and draws random numbers only from ``ctx.generator``.
"""

import contextlib
import dataclasses
import inspect
import typing
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeGuard, TypeVar

from jaxtyping import Bool, Float
from torch import Tensor

from ..checks import check_name, check_whole, shown
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
        return self._within(n_mapped, stride) % self.frames < stride and (
            is_keyframe is True or not self.only_keyframes
        )

    def starts_submap(self, n_mapped: int, *, stride: int = 1) -> bool:
        """Whether the frame after ``n_mapped`` others is the first of a submap; ``stride`` as for
        ``is_due``."""
        return self._within(n_mapped, stride) < stride

    def _within(self, n_mapped: int, stride: int) -> int:
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

_KNOWN_OPTIONS: weakref.WeakKeyDictionary[Any, dict[str, inspect.Parameter]] = (
    weakref.WeakKeyDictionary()
)
"""Rule -> its options, since reading a signature takes longer than many a step of a rule."""
F = TypeVar("F", bound=SeedingRule)

_RULES: dict[str, SeedingRule] = {}
_TRAINING = "published_training"


def seeding_rule(rule: F) -> F:
    """Register ``rule`` under its own name and return it unchanged; a rule of that name is
    replaced.

    Raises:
        TypeError: the signature is not ``(ctx, *, name=default, ...)`` with defaults that are
            numbers, True/False, a word of a ``Literal["...", ...]``, a text annotated ``str``, or a
            ``Path``; or the class is not as ``MapRule`` says.
    """
    if not callable(rule):
        raise KindError(
            f"@seeding_rule decorates a function, got {type(rule).__name__}; write it without "
            "parentheses"
        )
    if not rule_name(rule).isidentifier():
        raise KindError(
            f"a seeding rule is registered by its name, and {rule_name(rule)!r} is not a name: use "
            "def"
        )
    options_of(rule)
    _RULES[rule_name(rule)] = rule
    return rule


def trained_otherwise(training: str) -> Callable[[F], F]:
    """Say of a rule how its publication trains the Gaussians, where that is not how a comparison of
    rules trains them.

    Tables of the lab mark its row, because a number of it is one of the rule and not of the
    published system. Put it above ``@seeding_rule``.

    Args:
        training: A few words without a full stop: "centres fixed, 100 steps a frame".
    """

    def mark(rule: F) -> F:
        setattr(rule, _TRAINING, training)
        return rule

    return mark


def published_training(rule: SeedingRule) -> str:
    """How the publication of a rule trains the Gaussians, if that was said by
    ``trained_otherwise``; else empty. What a class derives from does not count."""
    return str(getattr(rule, "__dict__", {}).get(_TRAINING, ""))


def get_rule(rule: str | SeedingRule) -> SeedingRule:
    """The rule registered under a name; a function or class is returned unchanged after its
    signature was checked.

    Raises:
        KeyError: no rule of that name; the message lists the registered ones. TypeError: bad
            signature.
    """
    if isinstance(rule, str):
        check_name("seeding rule", rule, _RULES)
        return _RULES[rule]
    if isinstance(rule, MapRule):
        raise KindError(
            f"pass the class {type(rule).__name__} itself as the seeding rule, and its options in "
            "the settings: seeding__options={...}"
        )
    if not callable(rule):
        raise KindError(f"a seeding rule is a name or a function, got {type(rule).__name__}")
    options_of(rule)
    return rule


def registered() -> dict[str, SeedingRule]:
    """Name -> function or class of every registered rule, in order of registration (a copy)."""
    return dict(_RULES)


@contextlib.contextmanager
def keep_registered() -> Iterator[dict[str, SeedingRule]]:
    """Context in which rules can be registered, which are forgotten at its end; gives the rules
    registered before."""
    before = dict(_RULES)
    try:
        yield before
    finally:
        _RULES.clear()
        _RULES.update(before)


def rule_options(rule: str | SeedingRule) -> dict[str, Option]:
    """Option name -> default; sliders and check boxes are made from it."""
    return {name: parameter.default for name, parameter in options_of(get_rule(rule)).items()}


def rule_choices(rule: str | SeedingRule) -> dict[str, tuple[str, ...]]:
    """Option name -> allowed words, for the options that are one of these; drop-down lists are made
    from it."""
    found = {name: typing.get_args(p.annotation) for name, p in options_of(get_rule(rule)).items()}
    return {
        name: words
        for name, words in found.items()
        if words and all(isinstance(word, str) for word in words)
    }


def option_values(rule: SeedingRule, given: Mapping[str, Any]) -> dict[str, Option]:
    """The options as the rule is called with them: those that are paths as ``Path``, which settings
    hold as text.

    Raises:
        TypeError: as ``check_options``.
    """
    check_options(rule, given)
    known = options_of(rule)
    return {
        name: Path(value).expanduser() if isinstance(known[name].default, Path) else value
        for name, value in given.items()
    }


def option_paths(rule: SeedingRule, given: Mapping[str, Any]) -> dict[str, Path]:
    """Option name -> path, for the options that are paths; an empty one is no file, and is left
    out."""
    values = rule_options(rule) | option_values(rule, given)
    return {
        name: value for name, value in values.items() if isinstance(value, Path) and value != Path()
    }


def rule_name(rule: str | SeedingRule) -> str:
    """Name of a rule in messages and reports."""
    return rule if isinstance(rule, str) else getattr(rule, "__name__", type(rule).__name__)


def is_map_rule(rule: SeedingRule) -> TypeGuard[type[MapRule]]:
    """Whether the rule is a class."""
    return isinstance(rule, type) and issubclass(rule, MapRule)


def options_of(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    """The options of a rule by name.

    Raises:
        TypeError: the rule is not written as ``seeding_rule`` asks.
    """
    try:
        options = _KNOWN_OPTIONS.get(rule)
    except TypeError:  # an object that cannot be a key
        return _read_options(rule)
    if options is None:
        options = _KNOWN_OPTIONS[rule] = _read_options(rule)
    return options


def check_options(rule: SeedingRule, options: Mapping[str, Any]) -> None:
    """Raise ``TypeError`` for an option that the rule does not have, or a value of another type
    than its default's."""
    known = options_of(rule)
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise KindError(
            f"seeding rule {rule_name(rule)!r} has no options {shown(unknown)}; known: "
            f"{sorted(known)}"
        )
    for name, value in options.items():
        default = known[name].default
        if words := isinstance(default, str) and typing.get_args(known[name].annotation):
            fits = value in words
            wanted = words
        elif isinstance(default, Path):
            fits = isinstance(value, str | Path)
            wanted = "the path of a file or folder"
        elif isinstance(default, str):
            fits = isinstance(value, str)
            wanted = "a text"
        elif isinstance(default, bool):
            fits = isinstance(value, bool)
            wanted = "True or False"
        else:
            fits = isinstance(value, int | float) and not isinstance(value, bool)
            wanted = "a number"
        if not fits:
            raise KindError(
                f"seeding rule {rule_name(rule)!r}: option {name!r} must be {wanted}, got "
                f"{shown(value)}"
            )


def _read_options(rule: SeedingRule) -> dict[str, inspect.Parameter]:
    name = rule_name(rule)
    if isinstance(rule, type):
        wanted = (
            "a seeding rule that is a class is written  @dataclass(frozen=True, "
            f"kw_only=True) class {name}(MapRule)"
        )
        _check_class(rule, wanted)
        parameters = list(_signature(rule).parameters.values())
    else:
        wanted = f"a seeding rule is written  def {name}(ctx, *, number=default, ...) -> Seeds"
        parameters = list(_signature(rule).parameters.values())
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        if not parameters or parameters.pop(0).kind not in positional:
            raise KindError(f"{wanted}; this one does not take the context as its first argument")
    for parameter in parameters:
        _check_option(parameter, wanted)
    return {p.name: p for p in parameters}


def _check_option(p: inspect.Parameter, wanted: str) -> None:
    if p.kind is not inspect.Parameter.KEYWORD_ONLY:
        raise KindError(
            f"{wanted}; {str(p)!r} must be keyword-only: put it after a bare *, with a default"
        )
    if p.default is inspect.Parameter.empty:
        raise KindError(
            f"{wanted}; option {p.name!r} has no default, which sliders and check_rule need"
        )
    if not isinstance(p.default, Option):
        raise KindError(
            f"{wanted}; the default of option {p.name!r} must be a number, True/False, a text or a "
            f"Path, got {p.default!r}"
        )
    if (
        isinstance(p.default, str)
        and p.annotation is not str
        and p.default not in typing.get_args(p.annotation)
    ):
        raise KindError(
            f"{wanted}; option {p.name!r} is a text, so annotate it: {p.name}: str for any, Path "
            "for a file, or the "
            f'allowed words: {p.name}: Literal["{p.default}", ...] = "{p.default}"'
        )


def _check_class(rule: type, wanted: str) -> None:
    """Raise ``TypeError`` unless the class can be used as a rule."""
    if not issubclass(rule, MapRule):
        raise KindError(f"{wanted}; this one does not derive from gsfusion_nb.seeding.MapRule")
    if "__dataclass_fields__" not in vars(rule):
        raise KindError(
            f"{wanted}; this one is not a dataclass: put @dataclass(...) directly above the class"
        )
    if not all(f.kw_only for f in dataclasses.fields(rule)):
        raise KindError(f"{wanted}; this one was made without kw_only=True")
    if inspect.isabstract(rule):
        raise KindError(
            f"{wanted}; this one lacks {', '.join(sorted(rule.__abstractmethods__))}(self, ctx, "
            "memory)"
        )
    if len(inspect.signature(rule.seeds).parameters) != 3:
        raise KindError(f"{wanted}; its method must be  def seeds(self, ctx, memory) -> Seeds")
    kinds = {
        "when": (When, "EVERY_FRAME, KEYFRAMES, every(n) or submaps(n)"),
        "needs": (frozenset, "a frozenset of words"),
        "overrides": (Mapping, "values by name"),
    }
    for attribute, (kind, meaning) in kinds.items():
        if not isinstance(value := getattr(rule, attribute), kind):
            raise KindError(f"{wanted}; its {attribute} must be {meaning}, got {shown(value)}")
    check_needs(rule.needs, f"{wanted}; its needs")


def _signature(rule: SeedingRule) -> inspect.Signature:
    try:
        return inspect.signature(rule, eval_str=True)
    except (
        NameError,
        AttributeError,
        SyntaxError,
    ):  # an annotation written as text that cannot be evaluated here
        return inspect.signature(rule)
