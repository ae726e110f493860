"""GPS-SLAM (Peng et al. 2025): a coloured TSDF, and Gaussians for what its colours cannot show,
frame by frame."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..config import GpsSlamConfig, OptimConfig, gps_slam, gps_slam_fidelities, gps_slam_fidelity
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import Keyframe, ViewLoss, ViewStep, l1_mse_vjp, l2_mse_vjp
from ..render import OverBaseOutput, SurfacePicture
from ..seeding import SeedContext, SurfaceInputs
from ..tracking import Correction
from ..tsdf import FusedView, fuse_frame_
from ..types import Camera, Frame, RenderOutput
from .description import SystemDescription
from .gps_files import GpsFiles
from .gps_surface import OverSurface
from .gps_views import SurfaceKeyframe, ViewRound, look_at
from .step_report import StepReport, as_floats
from .transaction import Undo
from .tsdf_mapping import TsdfMapping
from .view_steps import step_on_view

LEAST_OPACITY = 0.005
"""Gaussians with a smaller opacity are removed (released code)."""

SURFACES_BYTES = 256 << 20
"""Memory for the surfaces that the passes after the scan have seen; the others are looked at anew
in each pass."""


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
        self.transaction.protect(self._undo_of_views)
        self._surfaces: dict[int, SurfaceKeyframe] = {}
        followed = gps_slam_fidelity(self.config).partition(",")[0]
        if followed != "measured":
            losses = " and its structural and depth losses" if followed == "rrg" else ""
            self.notes.append(
                f'GPS-SLAM with the fidelity "{followed}" still differs in what is not a setting, '
                "such as the order of "
                f"a frame, the stored colours, the cut of alpha{losses} (docs/gps_slam.md)"
            )

    def map_frame(self, frame: Frame) -> StepReport:
        """Propose seeds where the surface's picture is wrong, append, optimise views of the round,
        fuse.

        The frame is fused last, because that cannot be undone; what the rule and the optimisation
        see of the surface is without it. The first frame is therefore only fused, unless the rule
        needs no surface.
        """
        schedule = self.config.schedule
        is_keyframe = self.is_next_keyframe(frame)
        seeds_now = self.rule_is_due(is_keyframe)
        in_window = self.n_frames % schedule.window_every == 0
        with self.clock("tsdf"):
            missing = self._make_room(frame)
        with self.clock("base"):
            now = (
                self._look(self._kept(frame))
                if seeds_now or in_window or self.after_steps.edits
                else None
            )
        with self.clock("seeding"):
            preview = FusedView(self.volume, frame, missing)
            context = self._context(frame, None if now is None else now.surface, volume=preview)
            seeds = self.propose_seeds(context)
        with self.transaction.changes(undoable=self.views.steps_in(self.n_frames) > 0):
            if seeds_now and schedule.spread:
                self._prune()
            if seeds_now and self.config.residual.restart_adam:
                self._restart_adam()
            self.parts.append(seeds, frame.index)
            if is_keyframe:
                self.keyframes.append(frame, with_depth=self.training.loss is not None)
            with self.clock("base"):
                self._renew_views(now, in_window=in_window)
            with self.clock("optimise"):
                steps = self._optimise(context)
            if steps and not schedule.spread:
                self._prune()
        with self.clock("tsdf"):
            self.volume.allocate_missing(missing)
            fuse_frame_(self.volume, frame)
        return self.reports.of_frame(frame, seeds, is_keyframe, steps)

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame, after it was fused into the TSDF."""
        surface = self._look(Keyframe.of(frame.to(self.device))).surface
        return self._context(frame, surface, volume=self.volume)

    def _context(self, frame: Frame, surface: SurfacePicture | None, **more: Any) -> SeedContext:
        system = None
        if surface is not None:
            system = SurfaceInputs(surface=surface, seen_before=self._seen_before(frame))
        return super()._context(frame, near_m=self.config.tsdf.near_m, system=system, **more)

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe, or it is time
        for one."""
        views = self.config.views
        if not len(self.keyframes):
            return True
        due = views.every_frames and self.n_frames % views.every_frames == 0
        if not due:
            turned_deg, moved_m = se3.motion(
                self.keyframes[len(self.keyframes) - 1].T_WC, frame.T_WC
            )
            due = turned_deg > views.rotation_deg or moved_m > views.translation_m
        return bool(due) and not self._seen_before(frame)

    def _seen_before(self, frame: Frame) -> bool:
        # as released, nobody asks
        return bool(self.config.views.every_frames) and super()._seen_before(frame)

    def surface_picture(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfacePicture:
        """What a camera sees of the surface below the Gaussians, one ray for each pixel."""
        return self._over_surface.surface_picture(camera, T_WC)

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """Surface and Gaussians seen by a camera; alpha is 1 where there is a surface, and depth is
        the surface's."""
        return self._over_surface.render(camera, T_WC)

    @property
    def _over_surface(self) -> OverSurface:
        return OverSurface(
            volume=self.volume,
            params=self.params_now(),
            config=self.config.base,
        )

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

    def _undo_of_views(self) -> Undo:
        views = self.views.snapshot()

        def undo() -> None:
            self.views = views.snapshot()

        return undo

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure the views are at other poses, and the surface is another one."""
        super()._follow(correction)
        if correction is not None:
            self.views.forget()
            self.files.forget_discs()

    def _kept(self, frame: Frame) -> Keyframe:
        return Keyframe.of(frame, with_depth=self.training.loss is not None)

    def _look(self, keyframe: Keyframe) -> SurfaceKeyframe:
        return look_at(self.volume, keyframe.to(self.device), self.config.base)

    def _renew_views(self, now: SurfaceKeyframe | None, *, in_window: bool) -> None:
        """Look again at the views whose turn it is; ``now``: this frame, which becomes one of them
        if ``in_window``."""
        self._surfaces = {}
        views = self.views
        if in_window and now is not None and bool((now.seen_depth_m > 0).any()):
            views.add_frame(now)
        if not self.config.schedule.spread and views.steps_in(self.n_frames):
            views.look_again(self._look)
        n = views.recalls_in(self.n_frames)
        n_new = views.new_in(self.n_frames)
        views.recall(self.keyframes, self._look, self.random.keyframes, n, n_new)

    def _prune(self) -> None:
        """Remove Gaussians that have become too small, too large or transparent."""
        self.take_missed_steps()
        self.remove_lost()
        limits = self.config.residual
        params = self.gaussians.params
        radius_m = params.log_scale.amax(dim=1).exp()
        kept = (radius_m >= limits.min_radius_m) & (radius_m <= limits.max_radius_m)
        kept &= params.opacity_logit.sigmoid() >= LEAST_OPACITY
        if not bool(kept.all()):
            self.gaussians.will_change()
            self.gaussians.keep(kept)

    def _restart_adam(self) -> None:
        """Forget all moments and the number of steps, after rows have taken the steps that they
        missed."""
        self.take_missed_steps()
        self.gaussians.will_change()
        self.gaussians.restart_optimiser()

    def _optimise(self, context: SeedContext) -> list[list[float]]:
        """The steps of this frame, each on one of the views. Returns loss and mean squared error
        before each."""
        n = self.views.steps_in(self.n_frames) if len(self.views) and len(self.gaussians) else 0
        self.after_steps.frame_begins(context, n)
        views = [self.views.next_view(self.random.keyframes) for _ in range(n)]
        return as_floats(
            [self._optimise_view(view, views[i + 1 :]) for i, view in enumerate(views)]
        )

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe after the scan; each pass ends as a burst does, with the
        removal of rows."""
        view = self._surfaces.get(i)
        if view is None:
            view = look_at(
                self.volume,
                self.keyframes[i].to(self.device),
                self.config.base,
                full=True,
            )
            size = sum(
                x.nbytes
                for x in (*vars(view.surface.base).values(), view.seen_rgb, view.seen_depth_m)
            )
            if (len(self._surfaces) + 1) * size <= SURFACES_BYTES:
                self._surfaces[i] = view
        step = self._optimise_view(view)
        if not self.passes.queue:
            self._prune()
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
        part = self.parts.in_view(keyframe, [v.keyframe for v in later_views])
        step, statistics = step_on_view(
            self,
            keyframe,
            part,
            view.render,
            partial(self._loss, view=view),
            writes_back=not later_views or self.after_steps.is_used,
        )
        self.after_steps.edit(self, statistics, keyframe, step)
        return step

    def _loss(self, picture: OverBaseOutput, view: SurfaceKeyframe) -> tuple[ViewLoss, Tensor]:
        """L2 or L1 of the colours, or the given loss; and the MSE."""
        of_pixels = l2_mse_vjp if self.config.residual.loss == "l2" else l1_mse_vjp
        pixels = of_pixels(picture.rgb, view.keyframe.rgb)
        if self.training.loss is None:
            return ViewLoss(value=pixels.value, v_rgb=pixels.v_rgb), pixels.mse
        rendered = picture.as_render_output(view.surface.base)
        return self.training.view_loss(rendered, view.keyframe, with_depth=False), pixels.mse
