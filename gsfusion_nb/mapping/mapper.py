"""The interface of a mapping system: what each system defines, what all systems share, and what
runs need from them.

A system is one subclass of ``Mapper`` in this folder, its settings in ``gsfusion_nb/config``, and
one line in ``systems.py``. Everything around it (runs, report, checkpoints, command line, live
panels) uses only this interface.
"""

import contextlib
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import shown
from ..config import OptimConfig, SystemConfig, from_run, to_dict
from ..gaussians import GaussianModel
from ..interrupts import DelayedInterrupt
from ..large_maps import MapParts, drawn_in_part
from ..optim import (
    KeyframeList,
    UpdateFunction,
)
from ..render.near_plane import near_plane_m
from ..resources import MAP_MEMORY
from ..seeding import (
    SeedContext,
    SeedingRule,
    move_memory,
    rule_name,
)
from ..seeding.rule_code import find_rule
from ..tracking import Correction
from ..types import (
    Camera,
    Frame,
    Mesh,
    RenderOutput,
    Seeds,
)
from .after_scan import AfterScan, KeyframePasses
from .after_steps import AfterSteps
from .check_frame import check_frame
from .description import SystemDescription
from .localiser import Localiser, move_map
from .lost_rows import LostRows
from .map_files import MapFiles
from .map_reports import MapReports
from .mapper_copy import parts_of_copy
from .parts_of_map import parts_of_map
from .random_streams import RandomStreams
from .rule_calls import ask_rule, context_of
from .rule_in_use import RuleInUse, check_registered
from .rule_settings import settings_of_run, settings_with_rule
from .stage_clock import StageClock
from .step_report import GlobalStep, StepReport
from .tracking_surface import tracking_surface
from .training import LossFunction, Training, given_functions
from .transaction import Transaction
from .usual_torch import InUsualTorch, changeable, in_usual_torch, usual_torch

M = TypeVar("M", bound="Mapper")


class Mapper(InUsualTorch, ABC):
    """A mapping system: give it frames with ``step``; the map is ``gaussians``, and what the
    subclass adds.

    Args:
        config: Settings; the defaults of ``config_type`` if none are given.
        seeding: Name of a registered rule, "FILE.py:name", or the rule function itself; overrides
            ``config.seeding.rule``. The options in the settings are passed to it if it has all of
            them. If only ``config.seeding.rule`` has them, the rule runs with its defaults.
            Settings that the rule brings (``MapRule.overrides``) replace those in ``config`` that
            the user did not set (``settings_with_rule``). ``self.config`` has the settings in use.
        device: Device of the map.
        loss, optimiser: Given instead of the system's own loss and Adam (``Training``,
            ``LossFunction``, ``UpdateFunction``; docs/api.md has an example). Results name them.

    Raises:
        TypeError: neither rule has all of the options, or the value of an option is of the wrong
            type; ``loss`` or ``optimiser`` is no function.
        ValueError: the rule brings a setting that the system does not have.

    A subclass defines ``description``, ``config_type``, ``preset``, ``n_passes``, ``map_frame``,
    ``surface``, ``mesh`` and ``_global_step``. It overrides the rest where the default does not
    fit: ``state_dict`` and ``_load`` if it has state of its own, which ``TsdfMapping`` does for a
    TSDF, and ``files_type`` and ``reports_type`` if its files or reports have more in them. What
    else it has that lies in the world is moved with a loop by ``localiser.followers``.
    """

    _OFFERS = ("__init__", "surface", "mesh", "render", "seed_context")

    description: ClassVar[SystemDescription]
    """What the system says of itself."""
    config_type: ClassVar[type[SystemConfig]]
    """Class of the settings."""
    preset: ClassVar[Callable[..., Any]]
    """``preset(name, **overrides)``: settings as published for a data set; also takes ``fidelity``
    if there are any. It must know the names "room" and "replica", the defaults of the command
    line."""
    model_type: ClassVar[type[GaussianModel]] = GaussianModel
    """Class of the Gaussian map."""
    parts_type: ClassVar[Callable[..., MapParts]] = staticmethod(parts_of_map)
    """``parts_type(mapper)``: its ``parts``, the rows of the map that a view may show."""
    files_type: ClassVar[type[MapFiles]] = MapFiles
    """Class of ``files``, how the map is written and drawn from files."""
    reports_type: ClassVar[type[MapReports]] = MapReports
    """Class of ``reports``, what is said of a frame and of a run."""

    config: Any
    """The settings, a ``config_type``."""
    gaussians: Any
    """The Gaussian map, a ``model_type``."""
    mesh_share: float | None = None
    """Share of the surface seen that the last ``mesh`` has, where it is made from some of the
    views."""

    def __init__(
        self,
        config: Any = None,
        *,
        seeding: "str | SeedingRule | None" = None,
        device: torch.device | str = "cpu",
        loss: LossFunction | None = None,
        optimiser: UpdateFunction | None = None,
    ):
        self.training = Training(loss, optimiser)
        config = config or self.preset("replica")
        self.rule = find_rule(seeding if seeding is not None else config.seeding.rule)
        self.config = settings_with_rule(config, self.rule)
        self.rule_in_use = RuleInUse(self.rule, self.config.seeding.options)
        self.after_steps = AfterSteps(self.rule_in_use, near_plane_m(self.config))
        self.device = torch.device(device)
        self.gaussians = self.model_type(self.config.sh_degree, device=self.device)
        self.parts = self.parts_type(self)
        """The rows of ``gaussians`` that a view may show, which are drawn and stepped."""
        self.lost = LostRows()
        """How many Gaussians a step made NaN or infinite."""
        self.keyframes = KeyframeList("cpu" if self.config.keyframes_on == "cpu" else self.device)
        self.random = RandomStreams(self.config.seed)
        self.localiser = Localiser(self.config.tracking)
        self.localiser.followers.append(partial(_move_map, self))
        self.trajectory = self.localiser.trajectory
        """The pose of every frame mapped so far."""
        self.passes = KeyframePasses()
        self.transaction = Transaction(self)
        """Makes a frame change all of the map or nothing."""
        self.guard = self.transaction.guard
        self._after_scan = AfterScan(self)
        self.clock = StageClock()
        """Wall time of the stages of the last frame."""
        self.watch: Callable[[int | None], contextlib.AbstractContextManager[None]] = lambda _: (
            contextlib.nullcontext()
        )
        """Context around each frame (with its index) and each step after the scan (with None), for
        an observer."""
        self.n_frames = 0
        """Number of frames mapped so far."""
        self.notes: list[str] = []
        """Notes for the user about this mapper, as sentences."""
        self.files = self.files_type(self)
        """The map as files hold it, and as other programs draw it."""
        self.reports = self.reports_type(self)
        """Numbers and sentences about frames and runs."""

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.n_frames} frames, {len(self.gaussians):,} Gaussians, "
            f"{len(self.keyframes)} keyframes, rule {rule_name(self.rule)!r})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """For ``pickle`` and ``copy``: a mapper that goes on from exactly this state.

        Rule, loss and optimiser are those of this mapper. ``copy`` shares them, ``pickle`` stores
        where they can be imported from, so a function made in a cell needs ``cloudpickle``. An
        observer (``watch``) stays with this mapper.

        Raises:
            RuntimeError: a frame is being mapped.
            SequenceError: the rule stored something that a checkpoint does not hold either.
        """
        return parts_of_copy(self)

    @property
    @abstractmethod
    def n_passes(self) -> int:
        """Number of passes of the optimisation after the scan in the settings."""

    def step(self, frame: Frame) -> StepReport:
        """Map one frame, all of it or nothing: check it, find its pose, map it (``map_frame``),
        record its pose.

        Ctrl-C ends it at any place before the frame changes the map, or between two of its gradient
        steps if it can be undone; else it takes effect after the frame.

        Raises:
            BadFrameError: the frame cannot be used (``check_frame``), tracking is lost, or it is
                too far away for the voxel index. The map is unchanged.
            MemoryError: no room for new voxel blocks. The map is unchanged.
            RuntimeError: another thread is in a step, or an earlier frame was only half mapped. The
                map is unchanged.
            Exception: any error that the seeding rule raised. The map is unchanged.
        """
        index = frame.index
        needs_depth = self.description.needs_depth
        with DelayedInterrupt(), usual_torch():
            with (
                self.watch(index),
                self.guard.while_mapping(index),
                self.transaction,
            ):
                DelayedInterrupt.allow()
                self.clock = StageClock()
                frame = check_frame(changeable(frame), self.device, needs_depth=needs_depth)
                with self.clock("tracking"):
                    frame = _located(self, frame)
                report = self.map_frame(frame)
                self.transaction.keep()
                with self.clock("tracking"):
                    self._record(frame)
                self.n_frames += 1
            MAP_MEMORY.give_back()
            measured = {"tracking": self.localiser.report, "seconds": self.clock.seconds}
            return dataclasses.replace(report, **measured)

    def track_frame(self, frame: Frame) -> Frame:
        """The frame with its pose in the map, before it is mapped: the given one, or by ICP to
        ``surface``.

        A system that tracks in another way returns ``self.localiser.locate_by(find, frame)``, where
        ``find(frame, T_predicted)`` gives the camera-to-world pose [4, 4]. Nothing may change here.

        Raises:
            BadFrameError: the frame cannot be tracked.
        """
        return self.localiser.locate(frame, partial(tracking_surface, self))

    @abstractmethod
    def map_frame(self, frame: Frame) -> StepReport:
        """Map a frame that was checked and has a pose; the system's part of ``step``.

        What can fail because of the user's code comes first. All changes of the map are inside
        ``with self.transaction.changes(...)``, and changes that cannot be undone come last. All
        work that takes time is in a stage, ``with self.clock("optimise"): ...``: the speed of a run
        is computed from the sum of the stages.
        """

    @abstractmethod
    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Any:
        """The map's surface seen by a camera: ``rgb`` 0..1, ``depth_m`` (0 where there is none) and
        ``normal_W``."""

    @abstractmethod
    def mesh(self) -> Mesh:
        """Surface of the map."""

    @abstractmethod
    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step of the optimisation after the scan, on the i-th keyframe. Returns the loss
        before it."""

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """The Gaussian map seen by a camera."""
        T_WC = T_WC.to(self.device)
        return drawn_in_part(
            lambda params: self.files.render_gaussians(params, camera, T_WC, self.config),
            self.gaussians.params,
            self.parts.boxes,
            camera,
            T_WC,
            take=self.parts.params_now,
        )

    @property
    def row_optim(self) -> OptimConfig | None:
        """Settings of the Adam whose steps rows of the map may miss; None if there is none."""
        return None

    def global_optimise(self, passes: int | None = None) -> Iterator[GlobalStep]:
        """Optimise over the keyframes after the scan: each pass visits all of them once in a new
        random order.

        An iterator, so that the caller can show progress or stop:
        ``for step in mapper.global_optimise(): ...``.

        Args:
            passes: Number of passes; ``n_passes`` by default. A pass that was interrupted is
                finished first and counts as one of them.
        """
        return self._after_scan.steps(self.n_passes if passes is None else passes)

    def seed_context(self, frame: Frame, **inputs: Any) -> SeedContext:
        """What a seeding rule sees of this frame, with what the system gives besides: ``inputs``
        are further arguments of ``SeedContext``."""
        return context_of(self, frame, **inputs)

    def propose_seeds(self, context: SeedContext, **checks: Any) -> Seeds:
        """Ask the seeding rule for new Gaussians; there are none in a frame in which it is not due
        (``MapRule.when``).

        Args:
            context: What the rule sees.
            checks: Further arguments of ``apply_rule``.
        """
        return ask_rule(self, context, **checks)

    def is_next_keyframe(self, frame: Frame) -> bool | None:
        """Whether this frame, mapped next, becomes a keyframe; None if that depends on its
        seeds."""
        return None

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """Everything needed to continue later from exactly this state, as tensors and plain values.

        Args:
            copies: Without, large tensors are those of the map, which later frames change: to be
                written at once.
        """
        return {
            "config": to_dict(self.config),
            "rule": self.rule_in_use.state_dict(),
            "training": self.training.state_dict(),
            "n_frames": self.n_frames,
            "steps_taken": self.after_steps.n_steps,
            "n_not_finite": self.lost.total,
            "passes": self.passes.state_dict(),
            "localiser": self.localiser.state_dict(),
            "random": self.random.state_dict(),
            "gaussians": self.gaussians.state_dict(copies=copies),
            "keyframes": self.keyframes.state_dict(),
        }

    @classmethod
    @in_usual_torch
    def from_state_dict(
        cls: type[M],
        state: dict[str, Any],
        *,
        seeding: "str | SeedingRule | None" = None,
        device: torch.device | str = "cpu",
        loss: LossFunction | None = None,
        optimiser: UpdateFunction | None = None,
    ) -> M:
        """The mapper that was saved with ``state_dict``; a rule that is not registered by name must
        be given again, and so must a loss and an optimiser.

        Raises:
            SequenceError: the rule is neither given nor registered by its name, the loss or
                optimiser is not given, or one of them had a state that was not saved.
        """
        config = from_run(cls.config_type, state["config"])
        if seeding is None:
            check_registered(state["rule"])
        rule = find_rule(seeding if seeding is not None else state["rule"]["name"])
        settings = settings_of_run(config, rule)
        given = given_functions(loss, optimiser)
        mapper = cls(settings, seeding=rule, device=device, **given)
        mapper.notes += mapper.training.notes_on(state.get("training", {}))
        mapper.rule_in_use.load_state_dict(state["rule"])
        if changes := mapper.rule_in_use.difference(state["rule"]):
            mapper.notes.append(
                f"after {state['n_frames']} frames the run continued with another seeding rule, or "
                f"an edited one: {shown(rule_name(mapper.rule))} instead of "
                f"{shown(state['rule']['name'])}; different: {changes}"
            )
        mapper._load(state)
        return mapper

    def _load(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved; a subclass extends both."""
        self.localiser.load_state_dict(state["localiser"])
        self.n_frames = state["n_frames"]
        self.after_steps.n_steps = state["steps_taken"]
        self.lost.total = state.get("n_not_finite", 0)
        self.random.load_state_dict(state["random"])
        self.gaussians = self.model_type.from_state_dict(state["gaussians"], self.device)
        self.parts = self.parts_type(self)
        self.keyframes = KeyframeList.from_state_dict(state["keyframes"], self.keyframes.device)
        self.passes.load_state_dict(state["passes"])

    def _record(self, frame: Frame) -> None:
        """Add a mapped frame to the trajectory; the map moves with it if it closes a loop."""
        self.localiser.record(frame)


def _located(mapper: Mapper, frame: Frame) -> Frame:
    """``track_frame``; in the map of an earlier run the first frame is found by appearance, also
    where a system tracks in a way of its own."""
    if mapper.localiser.is_before_first_look:
        return Mapper.track_frame(mapper, frame)
    return mapper.track_frame(frame)


def _move_map(mapper: Mapper, correction: Correction) -> None:
    """After a loop closure, move Gaussians, keyframes and what the rule remembers of the world with
    the trajectory."""
    move_map(correction, mapper.gaussians, mapper.keyframes)
    move_memory(mapper.rule_in_use.memory, correction.transform_of)
