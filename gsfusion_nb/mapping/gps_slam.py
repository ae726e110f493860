"""GPS-SLAM (Peng et al. 2025): a coloured TSDF, and Gaussians for what its colours cannot show,
frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..config import GpsSlamConfig, OptimConfig, gps_slam, gps_slam_fidelities, gps_slam_fidelity
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import Keyframe, TrainingView, ViewLoss, ViewStep, l1_mse_vjp, l2_mse_vjp
from ..render import OverBaseOutput, SurfacePicture
from ..render.near_plane import near_plane_m
from ..seeding import SeedContext, SurfaceInputs
from ..tracking import Correction
from ..tsdf import FusedView, TsdfVolume, fuse_frame_
from ..types import Camera, Frame, GaussianParams, RenderOutput, Seeds
from .description import SystemDescription
from .gps_files import GpsFiles
from .gps_rounds import begin_round, remove_useless
from .gps_surface import OverSurface
from .gps_views import PassViews, SurfaceKeyframe, ViewRound, look_at
from .rule_calls import context_of, rule_is_due
from .step_report import StepReport, as_floats
from .training import Training
from .tsdf_mapping import TsdfMapping
from .view_steps import step_on_view


@dataclass(frozen=True, kw_only=True)
class FramePlan:
    """What is done with a frame."""

    is_keyframe: bool
    asks_rule: bool
    """Whether the seeding rule is asked, which begins a round."""
    in_window: bool
    """Whether the frame becomes one of the views."""
    needs_surface: bool
    """Whether somebody wants to know what the frame's camera sees of the surface."""


class GPSSLAM(TsdfMapping):
    """GPS-SLAM: its two maps are ``volume`` (TSDF) and ``gaussians``, which are drawn over the
    TSDF's picture.

    Settings: ``gsfusion_nb.config.gps_slam``.
    """

    description = SystemDescription(
        title="GPS-SLAM",
        fidelities=gps_slam_fidelities,
        fidelity_of=gps_slam_fidelity,
        panels=("input", "render", "error", "base", "residual", "new_gaussians"),
        needs_volume_to_render=True,
        memory_savers=("a larger views.every_frames", "larger voxels (tsdf.voxel_size_m)"),
    )
    config_type = GpsSlamConfig
    preset = staticmethod(gps_slam)
    files_type = GpsFiles

    config: GpsSlamConfig
    gaussians: GaussianModel
    files: GpsFiles

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.views = ViewRound(self.config.schedule)
        self.transaction.protect(self.views.undo_log)
        self.localiser.followers.append(self._forget_surface)
        self._pass_views = PassViews()
        self.notes += notes_on_fidelity(self.config)

    def map_frame(self, frame: Frame) -> StepReport:
        """Propose seeds where the surface's picture is wrong, append, optimise views of the round,
        fuse.

        The frame is fused last, because that cannot be undone; what the rule and the optimisation
        see of the surface is without it. The first frame is therefore only fused, unless the rule
        needs no surface.
        """
        plan = self._plan(frame)
        with self.clock("tsdf"):
            missing = self.make_room(frame)
        with self.clock("base"):
            view = self._look_at_frame(frame) if plan.needs_surface else None
        with self.clock("seeding"):
            context = self.seed_context(frame, FusedView(self.volume, frame, missing), view)
            seeds = self.propose_seeds(context)
        with self.transaction.changes(undoable=self.views.steps_in(self.n_frames) > 0):
            self._append(seeds, frame, plan)
            with self.clock("base"):
                self._renew_views(view if plan.in_window else None)
            with self.clock("optimise"):
                steps = self._optimise(context)
        with self.clock("tsdf"):
            self.volume.allocate_missing(missing)
            fuse_frame_(self.volume, frame)
        return self.reports.of_frame(frame, seeds, plan.is_keyframe, steps)

    def seed_context(
        self,
        frame: Frame,
        volume: TsdfVolume | FusedView | None = None,
        view: SurfaceKeyframe | None = None,
    ) -> SeedContext:
        """What a seeding rule sees of this frame; by default after it was fused into the TSDF.

        Args:
            frame: The frame.
            volume: The volume, if another one.
            view: What the frame's camera sees of the surface, if ``volume`` is given. None: the
                rule needs no surface.
        """
        if volume is None:
            volume = self.volume
            view = self._look(Keyframe.of(frame.to(self.device)))
        system = None
        if view is not None:
            system = SurfaceInputs(surface=view.surface, seen_before=self._seen_before(frame))
        return context_of(self, frame, volume=volume, system=system)

    def _plan(self, frame: Frame) -> FramePlan:
        """Whether the frame is a keyframe, and what is done with it."""
        is_keyframe = self.is_next_keyframe(frame)
        asks_rule = rule_is_due(self, is_keyframe)
        in_window = self.n_frames % self.config.schedule.window_every == 0
        return FramePlan(
            is_keyframe=is_keyframe,
            asks_rule=asks_rule,
            in_window=in_window,
            needs_surface=asks_rule or in_window or self.after_steps.edits,
        )

    def _append(self, seeds: Seeds, frame: Frame, plan: FramePlan) -> None:
        """Begin a round where the rule was asked; add the new Gaussians and the keyframe."""
        if plan.asks_rule:
            begin_round(self)
        self.parts.append(seeds, frame.index)
        if plan.is_keyframe:
            has_loss = self.training.loss is not None
            self.keyframes.append(frame, with_depth=has_loss, with_extra=has_loss)

    def _look_at_frame(self, frame: Frame) -> SurfaceKeyframe:
        has_loss = self.training.loss is not None
        return self._look(Keyframe.of(frame, with_depth=has_loss, with_extra=has_loss))

    def _renew_views(self, newest: SurfaceKeyframe | None) -> None:
        """Look again at the views whose turn it is; ``newest`` becomes one of them."""
        self._pass_views = PassViews()  # the surface will be another one
        self.views.renew(self.n_frames, newest, self.keyframes, self._look, self.random.keyframes)

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe, or it is time
        for one."""
        views = self.config.views
        if not len(self.keyframes):
            return True
        is_due = views.every_frames > 0 and self.n_frames % views.every_frames == 0
        if not is_due:
            last = self.keyframes[len(self.keyframes) - 1]
            angle_deg, distance_m = se3.motion(last.T_WC, frame.T_WC)
            is_due = angle_deg > views.rotation_deg or distance_m > views.translation_m
        return bool(is_due) and not self._seen_before(frame)

    def _seen_before(self, frame: Frame) -> bool:
        # as released, nobody asks
        return bool(self.config.views.every_frames) and super()._seen_before(frame)

    def surface_picture(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfacePicture:
        """What a camera sees of the surface below the Gaussians, one ray for each pixel."""
        return over_surface(self).surface_picture(camera, T_WC)

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """Surface and Gaussians seen by a camera; alpha is 1 where there is a surface, and depth is
        the surface's."""
        return over_surface(self).render(camera, T_WC)

    @property
    def row_optim(self) -> OptimConfig:
        """Learning rates of the Gaussians."""
        return self.config.residual.adam

    @property
    def n_passes(self) -> int:
        """Number of passes of the final optimisation in the settings."""
        return self.config.final.passes

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """The state of any mapper, the TSDF, and the views that are optimised."""
        return super().state_dict(copies=copies) | {"views": self.views.state_dict()}

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.views.load_state_dict(state["views"], self.config.base, self.device)

    def _forget_surface(self, correction: Correction) -> None:
        """After a loop closure the views are at other poses, and the surface is another one."""
        self.views.forget()
        self.files.forget_discs()

    def _look(self, keyframe: Keyframe) -> SurfaceKeyframe:
        return look_at(self.volume, keyframe.to(self.device), self.config.base)

    def _optimise(self, context: SeedContext) -> list[list[float]]:
        """The steps of this frame, each on one of the views; after a burst of them rows are
        removed. Returns loss and mean squared error before each."""
        n = self.views.steps_in(self.n_frames) if len(self.views) and len(self.gaussians) else 0
        self.after_steps.frame_begins(context, n)
        views = [self.views.next_view(self.random.keyframes) for _ in range(n)]
        steps = as_floats(
            [self._optimise_view(view, views[i + 1 :]) for i, view in enumerate(views)]
        )
        if steps and not self.config.schedule.spread:
            remove_useless(self)
        return steps

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe after the scan; each pass ends as a burst does, with the
        removal of rows."""
        keyframe = self.keyframes[i].to(self.device)
        view = self._pass_views.of(
            i, lambda: look_at(self.volume, keyframe, self.config.base, full=True)
        )
        step = self._optimise_view(view)
        if not self.passes.queue:
            remove_useless(self)
        return step.loss

    def _optimise_view(
        self, view: SurfaceKeyframe, later_views: Sequence[SurfaceKeyframe] = ()
    ) -> ViewStep:
        """One gradient step on one view; the surface is held fixed.

        Rows of ``later_views`` are stepped, too. They are in the map after the last step, or when a
        rule looks at it.
        """
        self.guard.may_stop()
        keyframe = view.keyframe
        target_rgb = keyframe.rgb
        part = self.parts.in_view(keyframe, [v.keyframe for v in later_views])
        step, statistics = step_on_view(
            self,
            keyframe,
            part,
            partial(view.render, near_m=near_plane_m(self.config)),
            partial(loss_of_view, self.config, self.training, view, target_rgb, part.params),
            writes_back=not later_views or self.after_steps.is_used,
        )
        self.after_steps.edit(self, statistics, keyframe, step, target_rgb)
        return step


def over_surface(mapper: GPSSLAM) -> OverSurface:
    """The two maps of a mapper, one over the other, as they are now."""
    params = mapper.parts.params_now()
    return OverSurface(
        volume=mapper.volume,
        params=params,
        config=mapper.config.base,
        near_m=near_plane_m(mapper.config),
    )


def loss_of_view(
    config: GpsSlamConfig,
    training: Training,
    view: SurfaceKeyframe,
    target_rgb: Float[Tensor, "H W 3"],
    params: GaussianParams,
    picture: OverBaseOutput,
) -> tuple[ViewLoss, Tensor]:
    """L2 or L1 of the colours, or the given loss; and the MSE."""
    of_pixels = l2_mse_vjp if config.residual.loss == "l2" else l1_mse_vjp
    pixels = of_pixels(picture.rgb, target_rgb)
    if training.loss is None:
        return ViewLoss(value=pixels.value, v_rgb=pixels.v_rgb), pixels.mse
    output = picture.as_render_output(view.surface.base)
    target = TrainingView.of(view.keyframe, rgb=target_rgb)
    return training.view_loss(output, target, params, with_geometry=False), pixels.mse


def notes_on_fidelity(config: GpsSlamConfig) -> list[str]:
    """A sentence on what settings cannot make as published, if they follow a publication."""
    fidelity = gps_slam_fidelity(config).partition(",")[0]
    if fidelity == "measured":
        return []
    losses = " and its structural and depth losses" if fidelity == "rrg" else ""
    return [
        f'GPS-SLAM with the fidelity "{fidelity}" still differs in what is not a setting, such as '
        f"the order of a frame, the stored colours, the cut of alpha{losses} (docs/gps_slam.md)"
    ]
