"""The seeding rule of a mapper: options, memory, times, settings that it brings, edits after
gradient steps."""

import contextlib
import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..checks import shown
from ..config import SystemConfig, from_dict
from ..config.values import NOT_FOR_RULES, tree_of, with_own_settings
from ..errors import ArgumentError, KindError, SequenceError
from ..gaussians import Edit, GaussianModel
from ..optim import Keyframe, TrainingView, ViewStep
from ..render import Footprints, footprints
from ..seeding import (
    EVERY_FRAME,
    MapRule,
    SeedContext,
    SeedingRule,
    StepStats,
    When,
    check_memory,
    copy_memory,
)
from ..seeding.code_key import code_key, differing, loaded_values, rule_fingerprint
from ..seeding.input_guard import unchanged_inputs
from ..seeding.map_rule import check_needs, is_map_rule, rule_name
from ..seeding.options import option_values
from ..seeding.points import add_up
from ..seeding.rule import registered, rule_options
from ..types import Camera, Frame

log = logging.getLogger(__name__)

S = TypeVar("S", bound=SystemConfig)

ONLY_IF_THERE = ("keyframe_every",)
"""Settings that a rule may bring to systems that do not have them: RTG-SLAM's keyframes never
depend on the seeds."""
ALL = "all"


class RuleInUse:
    """A rule with the options of one mapper, its fingerprint from when the mapper was made, and its
    memory.

    A function should depend on its context only; what it must remember belongs in ``ctx.memory``. A
    rule that stores something elsewhere can map, but its checkpoints cannot be resumed. The
    instances of a class (``MapRule``) are frozen, so its only state is its memory.

    Args:
        rule: The rule.
        options: Values of its options.

    Raises:
        TypeError: an option that the rule does not have, or a value of the wrong type. Also
            whatever a class raises in ``__post_init__`` for its options.
    """

    def __init__(self, rule: SeedingRule, options: dict[str, Any]):
        self.rule = rule
        values: Any = option_values(rule, options)
        self.map_rule: MapRule | None = rule(**values) if is_map_rule(rule) else None
        """The rule with its options, if it is a class."""
        self.when: When = self.map_rule.when if self.map_rule else EVERY_FRAME
        """In which frames it is asked for seeds."""
        self.memory: dict[str, Any] = {}
        """What it keeps from one frame to the next; always the same dict."""
        self.watched: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
        """Context around each call of the rule, for an observer."""
        key = code_key(rule)
        self._fingerprint = key.digest
        self._parts = dict(key.parts)
        self._values = loaded_values(rule)
        for kept in key.caches:  # of an earlier mapper; files may have changed since
            kept.cache_clear()

    def state_dict(self) -> dict[str, Any]:
        """Name and fingerprint of the rule, and its memory.

        Raises:
            TypeError: the memory holds something that a checkpoint cannot save.
        """
        check_memory(rule_name(self.rule), self.memory)
        return {
            "name": rule_name(self.rule),
            "fingerprint": self._fingerprint,
            "parts": dict(self._parts),
            "changed": self.map_rule is None and loaded_values(self.rule) != self._values,
            "memory": copy_memory(self.memory),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of the rule.

        Raises:
            SequenceError: the rule that made the checkpoint stored something that is not in it.
        """
        if state["changed"]:
            raise SequenceError(
                f"the seeding rule {shown(state['name'])} stores something from one frame to the "
                "next that is not in the checkpoint, so the run cannot continue to the same map; "
                "keep it in ctx.memory instead"
            )
        self.set_memory(state["memory"])

    def set_memory(self, memory: dict[str, Any]) -> None:
        """Replace the contents of the memory by a copy of ``memory``. Raises ``TypeError`` for an
        impossible one."""
        check_memory(rule_name(self.rule), memory)
        kept = copy_memory(memory)
        self.memory.clear()
        self.memory.update(kept)

    def difference(self, state: dict[str, Any]) -> str:
        """What differs from the rule of ``state`` in words: its name, or parts of its key; empty if
        nothing does."""
        if state["name"] != rule_name(self.rule):
            return "its name"
        if state["fingerprint"] == self._fingerprint:
            return ""
        return differing(state.get("parts", {}), self._parts) or "what cannot be hashed"


def check_known(state: dict[str, Any]) -> None:
    """Raise ``SequenceError`` if the rule of a checkpoint is not the one that is registered here by
    its name."""
    name = state["name"]
    known = registered().get(state["name"])
    if known is None or rule_fingerprint(known) != state["fingerprint"]:
        what = "is not known here"
        if known is not None:
            changes = differing(state.get("parts", {}), code_key(known).parts)
            what = f"is not the one that is registered here by that name (it differs in {changes})"
        raise SequenceError(
            f"the seeding rule {shown(name)} of this run {what}; its source is in rule.py of the "
            "run's folder: define "
            "it and continue with it in Python: resume_mapping(folder, seeding=<the rule>)"
        )


def settings_with_rule(config: S, rule: SeedingRule) -> S:
    """``config`` with everything that the rule decides, so that the stored settings are those of
    the run.

    Options: those in the settings are for the rule in the settings. Another rule gets them if it
    has all of them; if only the first rule has them, the other runs with its defaults. Options that
    neither has are returned unchanged; the mapper refuses them when it is made.

    Settings: what the user set counts more than what the rule brings (``MapRule.overrides``), and
    that more than defaults and fidelities. The user's are named in ``config.seeding.own_settings``:
    presets add what they set for a data set, ``gsfusion_nb.config.replace`` and the command line
    what they are asked to change.

    Raises:
        ValueError: the rule brings a setting that the system does not have, or a value that it
            refuses; or ``own_settings`` names a setting that the system does not have.
    """
    config = _with_options(config, rule)
    changes = _changes_by(rule, config)
    if not changes:
        return config
    for name, value in changes.items():
        log.info(
            "the seeding rule %r sets %s = %s, was %s",
            rule_name(rule),
            name,
            value,
            _value(config, name),
        )
    try:
        return from_dict(type(config), tree_of(changes, "."), start=config)
    except (TypeError, ValueError, KeyError) as e:
        raise ArgumentError(
            f"the seeding rule {rule_name(rule)!r} brings settings that are refused: {e}"
        ) from None


def settings_of_run(config: S, rule: SeedingRule) -> S:
    """``config`` of a run that continues with ``rule``, an edited or another one: the settings of
    the run stay."""
    return with_own_settings(config, sorted(_changes_by(rule, config)))


def _changes_by(rule: SeedingRule, config: SystemConfig) -> dict[str, Any]:
    """The settings that the rule changes, by dotted name, with their new values."""
    brought = _brought(config, rule)
    return {n: v for n, v in brought.items() if _value(config, n) != v and not _is_own(config, n)}


def _with_options(config: S, rule: SeedingRule) -> S:
    name = rule_name(rule)
    seeding = config.seeding
    if name == seeding.rule:
        return config
    options = seeding.options
    own = registered().get(seeding.rule)
    if (
        own is not None
        and not options.keys() <= rule_options(rule).keys()
        and options.keys() <= rule_options(own).keys()
    ):
        log.info(
            "the options %s belong to the seeding rule %r; %r runs with its defaults",
            options,
            seeding.rule,
            name,
        )
        options = {}
    return dataclasses.replace(
        config, seeding=dataclasses.replace(seeding, rule=name, options=options)
    )


def _brought(config: SystemConfig, rule: SeedingRule) -> dict[str, Any]:
    """The settings that a rule brings, by dotted name."""
    overrides = rule.overrides if is_map_rule(rule) else {}
    brought = {name.replace("__", "."): value for name, value in overrides.items()}
    brought = {
        name: value
        for name, value in brought.items()
        if name not in ONLY_IF_THERE or hasattr(config, name)
    }
    # of the recording, not of mapped frames
    if isinstance(every := brought.get("keyframe_every"), int) and every > 0:
        brought["keyframe_every"] = max(1, round(every / config.source_stride))
    for name in brought:
        if any(name == taken or name.startswith(f"{taken}.") for taken in NOT_FOR_RULES):
            raise ArgumentError(
                f"the seeding rule {rule_name(rule)!r} brings the setting {shown(name)}, which "
                f"only the user can set; a rule cannot bring {', '.join(NOT_FOR_RULES)}"
            )
    return brought


def _is_own(config: SystemConfig, name: str) -> bool:
    """Whether ``seeding.own_settings`` names a setting, its group, or all."""
    own = [entry.replace("__", ".").replace("-", "_") for entry in config.seeding.own_settings]
    for known in own:
        if known != ALL:
            _value(config, known)
    return any(entry in (ALL, name) or name.startswith(f"{entry}.") for entry in own)


def _value(config: SystemConfig, name: str) -> Any:
    """A setting by its dotted name. Raises ``ValueError`` if there is none of that name."""
    value: Any = config
    for part in name.split("."):
        if not dataclasses.is_dataclass(value) or not hasattr(value, part):
            raise ArgumentError(
                f"{type(config).__name__} has no setting {shown(name)}, which the seeding rule or "
                "seeding.own_settings names"
            )
        value = getattr(value, part)
    return value


@dataclass(frozen=True, kw_only=True, eq=False)
class WatchedStep:
    """What is collected while a step is taken."""

    footprints: Footprints | None = None
    """Of all rows of the map."""
    v_uv: Float[Tensor, "N 2"] | None = None
    """To be filled by ``render_vjp``, one row for each Gaussian that it is given."""
    v_uv_abs: Float[Tensor, "N 2"] | None = None
    """Likewise."""

    @property
    def outputs(self) -> dict[str, Tensor | None]:
        """What ``render_vjp`` is asked to fill, by the name of its argument."""
        return {"v_uv": self.v_uv, "v_uv_abs": self.v_uv_abs}


class AfterSteps:
    """Collects the statistics of gradient steps that a rule asks for, and lets it edit the map
    after them.

    Args:
        rule: The rule of the mapper; a function neither asks for statistics nor edits.
    """

    def __init__(self, rule: RuleInUse):
        made = rule.map_rule
        self._used = rule
        self._rule = made
        self._name = rule_name(rule.rule)
        self._needs: frozenset[str] = frozenset() if made is None else made.statistics()
        check_needs(self._needs, f"seeding rule {self._name!r}: statistics()")
        self.edits = made is not None and type(made).after_step is not MapRule.after_step
        """Whether the rule may edit the map after a step."""
        self.is_used = self.edits or bool(self._needs)
        """Whether anything at all is done after a step."""
        self.taken = 0
        """Number of gradient steps so far; counted only if ``is_used``."""
        self._context: SeedContext | None = None
        self._steps_in_frame = 1
        self._first = 0

    def frame_begins(self, context: SeedContext, n_steps: int) -> None:
        """The frame of ``context`` will be optimised with ``n_steps`` gradient steps."""
        self._context = context
        self._steps_in_frame = n_steps
        self._first = self.taken

    def frame_ends(self) -> None:
        """Further steps belong to the passes after the scan."""
        self._context = None

    def watch(
        self, model: GaussianModel, view: Frame | Keyframe | TrainingView, n_rows: int | None = None
    ) -> WatchedStep:
        """Begin a step; nothing is collected of it unless the rule asks for it.

        Args:
            model: The map before the step.
            view: What is rendered.
            n_rows: Number of rows that are rendered; all by default.
        """
        if not self.is_used:
            return WatchedStep()
        seen = (
            footprints(model.params, view.camera, view.T_WC) if self._needs - {"render"} else None
        )
        n = len(model) if n_rows is None else n_rows
        asked = [name in self._needs for name in ("image_gradients", "abs_image_gradients")]
        v_uv, v_uv_abs = (
            torch.zeros(n, 2, device=model.device) if wanted else None for wanted in asked
        )
        return WatchedStep(footprints=seen, v_uv=v_uv, v_uv_abs=v_uv_abs)

    def add_up(
        self,
        model: GaussianModel,
        step: WatchedStep,
        camera: Camera,
        rows: Int[Tensor, " R"] | None = None,
    ) -> WatchedStep:
        """Count a step and add it to the statistics of each row; returns it with gradients for all
        rows of the map.

        Args:
            model: The map.
            step: From ``watch``.
            camera: That of the view.
            rows: Row of the map of each rendered Gaussian, if not all were.
        """
        self.taken += self.is_used
        seen = step.footprints
        if seen is None:
            return step
        if rows is not None:
            v_uv, v_uv_abs = (
                _spread(values, rows, len(model)) for values in (step.v_uv, step.v_uv_abs)
            )
            step = WatchedStep(footprints=seen, v_uv=v_uv, v_uv_abs=v_uv_abs)
        add_up(model, seen.visible, step.v_uv, camera, step.v_uv_abs)
        return step

    def edit(
        self,
        mapper: Any,
        step: WatchedStep,
        view: Frame | Keyframe,
        view_step: ViewStep,
    ) -> None:
        """Let the rule edit the map, after a step was written to it.

        Args:
            mapper: The ``Mapper``, for its map, and its contexts of keyframes in the passes after
                the scan.
            step: From ``add_up``.
            view: What was rendered.
            view_step: Loss and picture before the step.

        Raises:
            Exception: what the rule raises, or ``ValueError`` if its edit is not possible. The map
                has no part of the edit. In the passes after the scan the rule's memory and its
                random numbers are as before the call; online, whoever undoes the frame restores
                them.
        """
        if not self.edits:
            return
        mapper.take_missed_steps()  # an edit reads, copies and removes any row
        if self._context is not None:
            self._edit(
                mapper, dataclasses.replace(self._context), self._stats(step, view, view_step)
            )
            return
        ctx = mapper.seed_context(_as_frame(view))
        memory = copy_memory(ctx.memory)
        random_numbers = ctx.generator.get_state()
        try:
            self._edit(mapper, ctx, self._stats(step, view, view_step))
        except BaseException:
            ctx.memory.clear()
            ctx.memory.update(memory)
            ctx.generator.set_state(random_numbers)
            raise

    def _stats(self, step: WatchedStep, view: Frame | Keyframe, view_step: ViewStep) -> StepStats:
        online = self._context is not None
        seen = step.footprints
        return StepStats(
            step=self.taken,
            stage="online" if online else "passes",
            step_in_frame=self.taken - self._first if online else 1,
            steps_in_frame=self._steps_in_frame if online else 1,
            frame_index=view.index,
            camera=view.camera,
            T_WC=view.T_WC,
            target=view.rgb,
            loss=view_step.loss,
            rgb=view_step.rgb if "render" in self._needs else None,
            visible=None if seen is None else seen.visible,
            radius_px=None if seen is None else seen.radius_px,
            v_uv=step.v_uv,
            v_uv_abs=step.v_uv_abs,
        )

    def _edit(self, mapper: Any, ctx: SeedContext, stats: StepStats) -> None:
        assert self._rule is not None
        with self._used.watched(), unchanged_inputs(ctx, self._used.rule, is_quick=True):
            edit = self._rule.after_step(ctx, stats, ctx.memory)
        check_memory(self._name, ctx.memory)
        if edit is None:
            return
        if not isinstance(edit, Edit):
            raise KindError(
                f"seeding rule {self._name!r}: after_step must return an Edit or None, got "
                f"{shown(edit)}"
            )
        try:
            before = mapper.gaussians.edit(edit, ctx.generator, ctx.frame.index)
        except ValueError as error:
            raise ArgumentError(
                f"seeding rule {self._name!r} returned an impossible edit: {error}"
            ) from None
        mapper.rows_changed(before)


def _spread(
    values: Float[Tensor, "R 2"] | None, rows: Int[Tensor, " R"], n: int
) -> Float[Tensor, "N 2"] | None:
    """Values of some rows, zero for the other rows of the ``n``."""
    return None if values is None else values.new_zeros(n, 2).index_copy_(0, rows, values)


def _as_frame(view: Frame | Keyframe) -> Frame:
    """A keyframe as a frame: at time 0, and without depth if it has none."""
    if isinstance(view, Frame):
        return view
    size = view.rgb_u8.shape[:2]
    depth_m = view.depth_m
    depth_m = torch.zeros(size, device=view.rgb_u8.device) if depth_m is None else depth_m
    return Frame(
        index=view.index,
        timestamp_s=0.0,
        colour=view.rgb_u8,
        depth_m=depth_m,
        camera=view.camera,
        T_WC=view.T_WC,
    )
