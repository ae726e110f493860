"""The interface of a mapping system: what each system defines, what all systems share, and what runs need from them.

A system is one subclass of ``Mapper`` in this folder, its settings in ``gsfusion_nb/config``, and one line in
``systems.py``. Everything around it (runs, report, checkpoints, command line, live panels) uses only this interface.
"""

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..config import SystemConfig
from ..gaussians import GaussianModel
from ..operands import FAR_DEPTH_M
from ..optim import KeyframeList, UpdateFunction
from ..render import render
from ..seeding import Cells, ChangedInputError, SeedingRule, copy_memory, move_memory, rule_name
from ..seeding.rule_file import find_rule
from ..tracking import Correction
from ..types import Camera, Frame, GaussianParams, Mesh, RenderOutput
from .after_steps import AfterSteps
from .asks_rule import AsksRule
from .keyframe_passes import KeyframePasses
from .localiser import Localiser, move_map
from .map_view import MapPart, SurfaceImage
from .one_frame import FrameGuard
from .random_streams import RandomStreams
from .rule_in_use import RuleInUse
from .rule_settings import settings_with_rule
from .saved_state import SavesState
from .step_report import GlobalStep, StepReport
from .stored_map import StoredMap
from .training import LossFunction, Training


class Mapper(AsksRule, SavesState, StoredMap, ABC):
    """A mapping system: give it frames with ``step``; the map is ``gaussians``, and what the subclass adds.

    Args:
        config: Settings; the defaults of ``config_type`` if none are given.
        seeding: Name of a registered rule, "FILE.py:name", or the rule function itself; overrides
            ``config.seeding.rule``. The options in the settings are passed to it if it has all of them. If only
            ``config.seeding.rule`` has them, the rule runs with its defaults. Settings that the rule brings
            (``MapRule.overrides``) replace the usual values in ``config``, not the user's own (``rule_settings``).
            ``self.config`` has the settings in use.
        device: Device of the map.
        loss, optimiser: Given instead of the system's own loss and Adam (``Training``, ``LossFunction``,
            ``UpdateFunction``; docs/api.md has an example). Results name them.

    Raises:
        TypeError: neither rule has all of the options, or the value of an option is of the wrong type; ``loss`` or
            ``optimiser`` is no function.
        ValueError: the rule brings a setting that the system does not have.

    A subclass defines ``title``, ``config_type``, ``preset``, ``n_passes``, ``step``, ``surface``, ``mesh`` and
    ``_global_step``. It overrides the rest where the default does not fit.
    """

    title: ClassVar[str]
    """Name of the system in reports and messages."""
    config_type: ClassVar[type[SystemConfig]]
    """Class of the settings."""
    preset: ClassVar[Callable[..., Any]]
    """``preset(name, **overrides)``: settings as published for a data set; also takes ``fidelity`` if there are any.
    It must know the names "room" and "replica", the defaults of the command line."""
    fidelities: ClassVar[tuple[str, ...]] = ()
    """Values of ``fidelity`` (what to follow where paper and released code differ), the default first; may be empty."""
    fidelity_of: ClassVar[Callable[[Any], str]] = staticmethod(lambda config: "")
    """``fidelity_of(config)``: which of ``fidelities`` the settings follow, with exceptions, in words; "" if none."""
    model_type: ClassVar[type[GaussianModel]] = GaussianModel
    """Class of the Gaussian map."""
    gaussians_are_discs: ClassVar[bool] = False
    """Whether the Gaussians are discs on the surface; then their distance to the true surface is scored, too."""
    panels: ClassVar[tuple[str, ...]] = ("input", "render", "error", "new_gaussians")
    """Pictures of one step to show while mapping, by name; ``gsfusion_nb.viz.map_pictures.PANELS`` draws them."""
    curves: ClassVar[dict[str, Callable[[StepReport], float | int]]] = {
        "PSNR of the frame, dB": lambda report: report.psnr_after_db,
        "Gaussians": lambda report: report.n_gaussians,
    }
    """Title -> value after a step, plotted while mapping; NaN leaves a gap."""
    asks_rule: ClassVar[bool] = True
    """Whether new Gaussians come from the seeding rule; the report then names it."""
    needs_volume_to_render: ClassVar[bool] = False
    """Whether the picture needs more than the Gaussians: then ``gaussians.ply`` alone does not show the map
    (``StoredMap``)."""
    memory_savers: ClassVar[tuple[str, ...]] = ()
    """Settings, besides smaller images, that reduce the memory of the map; named in the message when memory is full."""

    config: Any
    """The settings, a ``config_type``."""
    gaussians: Any
    """The Gaussian map, a ``model_type``."""

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
        config = config or self.config_type()
        self.rule = find_rule(seeding if seeding is not None else config.seeding.rule)
        self.config = settings_with_rule(config, self.rule, type(self))
        self.rule_in_use = RuleInUse(self.rule, self.config.seeding.options)
        self.after_steps = AfterSteps(self.rule_in_use)
        self.device = torch.device(device)
        self.gaussians = self.model_type(self.config.sh_degree, device=self.device)
        self.keyframes = KeyframeList("cpu" if self.config.keyframes_on == "cpu" else self.device)
        self.random = RandomStreams(self.config.seed)
        self.localiser = Localiser(self.config.tracking)
        self.passes = KeyframePasses()
        self.guard = FrameGuard()
        self.watch: Callable[[int | None], contextlib.AbstractContextManager[None]] = lambda _: contextlib.nullcontext()
        """Context around each frame (with its index) and each step after the scan (with None), for an observer."""
        self._told_far = False
        self.n_frames = 0
        """Number of frames mapped so far."""
        self.notes: list[str] = []
        """Notes for the user about this mapper, as sentences."""

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.n_frames} frames, {len(self.gaussians):,} Gaussians, "
            f"{len(self.keyframes)} keyframes, rule {rule_name(self.rule)!r}{self.rule_in_use.memory_note})"
        )

    @property
    @abstractmethod
    def n_passes(self) -> int:
        """Number of passes of the optimisation after the scan in the settings."""

    @abstractmethod
    def step(self, frame: Frame) -> StepReport:
        """Map one frame. A subclass does so inside ``with self.one_frame(frame)``.

        All work that takes time belongs in a stage, ``with clock("optimise"): ...`` with a ``StageClock``: the speed
        that a run reports is computed from the sum of the stages, ``StepReport.seconds``.

        Raises:
            BadFrameError: the frame cannot be used. The map is unchanged.
            RuntimeError: another thread is in a step, or an earlier frame was only half mapped. The map is unchanged.
            Exception: any error that the seeding rule raised. The map is unchanged.
        """

    @abstractmethod
    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfaceImage:
        """Depth, normals and colours of the map's surface seen by a camera."""

    @abstractmethod
    def mesh(self) -> Mesh:
        """Surface of the map."""

    @abstractmethod
    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step of the optimisation after the scan, on the i-th keyframe. Returns the loss before it."""

    @classmethod
    def render_gaussians(
        cls, params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"], config: Any
    ) -> RenderOutput:
        """Gaussians as this system renders and scores them. Default: blended colour and depth (Kerbl et al. 2023).

        Args:
            params: The Gaussians, of a mapper or read from a file.
            camera, T_WC: The camera and its pose.
            config: Settings of the system.
        """
        return render(params, camera, T_WC)

    def begin_with(self, params: GaussianParams, name: str = "another map") -> None:
        """Put Gaussians that were optimised elsewhere into the map before the first frame; they are optimised further.

        They must be in the world frame of the poses, in metres. The volume stays empty: the surface comes from the
        frames. A seeding rule sees them like its own.

        Args:
            params: The Gaussians.
            name: Of the file, for the notes of the run.

        Raises:
            ValueError: a frame was mapped before, a number is not finite, or the system cannot use them.
        """
        if self.n_frames:
            raise ValueError(
                f"a map can only begin with other Gaussians before its first frame; {self.n_frames} are mapped"
            )
        self.gaussians.extend(params)
        self.notes.append(f"the map began with {len(params):,} Gaussians of {name}")

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """The Gaussian map seen by a camera."""
        return self.render_gaussians(self.gaussians.params, camera, T_WC.to(self.device), self.config)

    def global_optimise(self, passes: int | None = None) -> Iterator[GlobalStep]:
        """Optimise over the keyframes after the scan: each pass visits all of them once in a new random order.

        A generator, so that the caller can show progress or stop: ``for step in mapper.global_optimise(): ...``.

        Args:
            passes: Number of passes; ``n_passes`` by default. A pass that was interrupted is finished first and counts
                as one of them.
        """
        passes = self.n_passes if passes is None else passes
        if not self.passes.begun:
            self._follow(self.localiser.finish())
        yield from self.passes.run(passes, len(self.keyframes), self.random.passes, self._watched_global_step)

    def _watched_global_step(self, i: int) -> Float[Tensor, ""]:
        with self.watch(None):
            return self._global_step(i)

    @contextlib.contextmanager
    def one_frame(self, frame: Frame) -> Iterator[None]:
        """Context in which ``frame`` is mapped, all of it or nothing, by one thread at a time.

        In it ``self.guard.changes_begin()`` separates what can fail (checks, tracking, the seeding rule) from what
        changes the map. If the first part fails, the random numbers, the rule's memory and the tracked pose are
        restored; if the second part fails before ``changes_stay`` and ``changes_begin`` was given ``_undo()``, so is
        the map.
        """
        with self.watch(frame.index), self.guard.one_frame(frame.index):
            random_numbers, memory = self.random.state_dict(), copy_memory(self.memory)
            try:
                yield
            except BaseException as e:
                if isinstance(e, ChangedInputError) and e.changed_map and not self.guard.can_undo:
                    self.guard.half_mapped = f"at frame {frame.index} the map was changed by its {e}"
                if self.guard.undo():
                    self.random.load_state_dict(random_numbers)
                    self.rule_in_use.set_memory(memory)
                    self.localiser.take_back()
                raise
            finally:
                self.after_steps.frame_ends()
            if self.passes.begun:  # with more frames, the optimisation after the scan starts again
                self.passes = KeyframePasses()

    def _undo(self) -> Callable[[], None]:
        """A function that undoes what a frame changes in the map, from now on; a subclass extends it."""
        rows, steps, taken = self.gaussians.snapshot(), self.gaussians.step_count, self.after_steps.taken
        n_keyframes = len(self.keyframes)

        def undo() -> None:
            self.gaussians.restore(rows)
            self.gaussians.step_count, self.after_steps.taken = steps, taken
            self.keyframes.cut(n_keyframes)

        return undo

    def rows_changed(self, before: Int[Tensor, " N"]) -> None:
        """Called after a rule's edit of the map; a subclass that holds copies of rows brings them up to date.

        Args:
            before: For each row of the map its number before the edit, -1 for new rows. [N]
        """

    def counts(self) -> dict[str, int]:
        """Sizes of the map besides its Gaussians and keyframes, with their names in metrics.json."""
        return {}

    def maps(self) -> dict[str, dict[str, Tensor]]:
        """The tensors of each map, by name; two runs have the same maps if these are equal."""
        return {"gaussians": vars(self.gaussians.params)}

    def parts(self) -> list[MapPart]:
        """What the map consists of and how much memory each part takes; the rule's memory only if it has one."""
        parts = [
            MapPart(name="Gaussians", count=len(self.gaussians), size_bytes=self.gaussians.memory_bytes),
            MapPart(name="keyframes", count=len(self.keyframes), size_bytes=self.keyframes.size_bytes),
        ]
        kept = MapPart(name="values kept by the rule", count=len(self.memory), size_bytes=self.rule_in_use.memory_bytes)
        return [*parts, kept] if self.memory else parts

    def mesh_on_cpu(self) -> Mesh | None:
        """The mesh, computed without a GPU whose memory is full; ``None`` if that is not possible."""
        return None

    def quadtree_cells(self, frame: Frame) -> Cells | None:
        """The quadtree cells of the frame that seeding used; ``None`` if the system has no quadtree."""
        return None

    def step_warnings(self, frame: Frame, report: StepReport) -> list[str]:
        """Warnings for the user about the step that gave ``report``, as sentences."""
        warnings, depth_m = [], frame.depth_m[::8, ::8]
        if report.tracking.get("status") == "recovered":
            warnings.append(f"frame {frame.index}: tracking was lost and has recovered")
        if self.localiser.jump:
            warnings.append(f"frame {frame.index} was mapped although {self.localiser.jump}")
        median_m = float(depth_m[depth_m > 0].median()) if bool((depth_m > 0).any()) else 0.0
        if median_m > FAR_DEPTH_M and not self._told_far:
            self._told_far = True
            warnings.append(
                f"frame {frame.index}, and perhaps later ones, was mapped with a median depth of {median_m:.4g} m, "
                "which no depth camera measures: is it a code for missing depth, or the wrong depth scale? "
                f"--data.depth-max-m {FAR_DEPTH_M:g} leaves it out"
            )
        return warnings

    def _record(self, frame: Frame) -> None:
        """Add a mapped frame to the trajectory, and follow the correction if it closes a loop."""
        self._follow(self.localiser.record(frame))

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure, move Gaussians, keyframes and what the rule remembers of the world with the trajectory,
        if the settings say so."""
        if correction is not None and self.config.tracking.back_end.on_correction == "move":
            move_map(correction, self.gaussians, self.keyframes)
            move_memory(self.memory, correction.transform_of)
