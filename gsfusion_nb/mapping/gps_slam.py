"""GPS-SLAM (Peng et al. 2025): a coloured TSDF, and Gaussians for what its colours cannot show, frame by frame."""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import observed, runs_learners_code
from ..config import GPS_SLAM_DIFFERS, GpsSlamConfig, gps_slam, gps_slam_fidelity
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import Keyframe, adam_step, dssim_vjp, l1_mse_vjp, l2_mse_vjp
from ..render import BaseView, render_over_base, render_over_base_vjp
from ..seeding import SeedContext
from ..tracking import Correction, tsdf_surface
from ..tsdf import FusedView, fuse_frame_
from ..types import Camera, Frame, RenderOutput
from .based_views import BasedView, ViewRound, look_at
from .frame_checks import check_frame
from .over_surface import OverSurface, StoredWithSurface
from .step_report import StageClock, StepReport, psnr_from_mse
from .tsdf_mapping import TsdfMapping

KEPT_BASES_BYTES = 256 << 20
"""Memory for the surfaces that the passes after the scan have seen; the others are looked at anew in each pass."""


class GPSSLAM(StoredWithSurface, TsdfMapping):
    """GPS-SLAM: its two maps are ``volume`` (TSDF) and ``gaussians``, which are drawn over the TSDF's picture.

    Settings: ``gsfusion_nb.config.gps_slam``.
    """

    title = "GPS-SLAM"
    config_type = GpsSlamConfig
    preset = staticmethod(gps_slam)
    fidelities = ("measured", "paper", "code")
    fidelity_of = staticmethod(gps_slam_fidelity)
    panels = ("input", "render", "error", "base", "residual", "new_gaussians")
    memory_savers = ("a larger views.every_frames", "larger voxels (tsdf.voxel_size_m)")
    needs_volume_to_render: ClassVar = True

    config: GpsSlamConfig
    gaussians: GaussianModel

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.views = ViewRound(self.config.schedule)
        self._kept_bases: dict[int, BasedView] = {}
        followed = gps_slam_fidelity(self.config).partition(",")[0]
        self.notes += [GPS_SLAM_DIFFERS[followed]] if followed in GPS_SLAM_DIFFERS else []

    def step(self, frame: Frame) -> StepReport:
        """Map one frame, all of it or nothing.

        Here the frame is fused last, because that cannot be undone; what the rule and the optimisation see of the
        surface is without it. The first frame is therefore only fused, unless the rule needs no surface.

        Raises:
            BadFrameError: the frame cannot be used. The maps are unchanged.
            MemoryError: no room for the new voxel blocks. The maps are unchanged.
            RuntimeError: another thread is in a step, or an earlier frame was only half mapped.
        """
        with self.one_frame(frame):
            frame, clock = check_frame(frame, self.device), StageClock()
            with clock("tracking"):
                frame = self.localiser.locate(frame, tsdf_surface(self.volume))
            with clock("tsdf"):
                missing = self._make_room(frame)
            is_keyframe = self.is_next_keyframe(frame)
            seeds_now = self.rule_is_due(is_keyframe)
            in_window = self.n_frames % self.config.schedule.window_every == 0
            with clock("base"):
                now = self._look(self._kept(frame)) if seeds_now or in_window or self.after_steps.edits else None
            with clock("seeding"):
                preview = FusedView(self.volume, frame, missing)
                below = None if now is None else now.below
                context = self._context(frame, volume=preview, near_m=self.config.tsdf.near_m, below=below)
                seeds = self.propose_seeds(context)
            can_fail = (
                self.after_steps.edits
                or self.training.names
                or runs_learners_code()
                or self.views.steps_in(self.n_frames) > 0
            )
            self.guard.changes_begin(self._undo() if can_fail else None)
            if seeds_now and self.config.schedule.spread:
                self._prune()
            if seeds_now and self.config.residual.restart_adam:
                self._restart_adam()
            self.gaussians.append(seeds, frame.index)
            if is_keyframe:
                self.keyframes.append(frame, with_depth=self.training.loss is not None)
            with clock("base"):
                self._renew_views(now, in_window=in_window)
            with clock("optimise"):
                losses, psnrs = self._optimise(context)
            if losses and not self.config.schedule.spread:
                self._prune()
            self.guard.changes_stay()
            with clock("tsdf"):
                self.volume.allocate_missing(missing)
                fuse_frame_(self.volume, frame)
            with clock("tracking"):
                self._record(frame)
            self.n_frames += 1
        return StepReport(
            frame_index=frame.index,
            n_seeds=len(seeds),
            n_gaussians=len(self.gaussians),
            n_blocks=self.volume.n_blocks,
            n_steps=len(losses),
            is_keyframe=is_keyframe,
            losses=tuple(losses),
            psnr_before_db=psnrs[0] if psnrs else math.nan,
            psnr_after_db=psnrs[-1] if psnrs else math.nan,
            tracking=self.localiser.report,
            seconds=clock.seconds,
        )

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame, after it was fused into the TSDF."""
        below = self._look(Keyframe.of(frame.to(self.device))).below
        return self._context(frame, volume=self.volume, near_m=self.config.tsdf.near_m, below=below)

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe, or it is time for one."""
        views = self.config.views
        if not len(self.keyframes) or (views.every_frames and self.n_frames % views.every_frames == 0):
            return True
        turned_deg, moved_m = se3.motion(self.keyframes[len(self.keyframes) - 1].T_WC, frame.T_WC)
        return turned_deg > views.rotation_deg or moved_m > views.translation_m

    def below(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> BaseView:
        """What a camera sees of the surface below the Gaussians, one ray for each pixel."""
        return self._over_surface.below(camera, T_WC)

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """Surface and Gaussians seen by a camera; alpha is 1 where there is a surface, and depth is the surface's."""
        return self._over_surface.render(camera, T_WC)

    @property
    def _over_surface(self) -> OverSurface:
        return OverSurface(volume=self.volume, params=self.gaussians.params, config=self.config.base)

    @property
    def n_passes(self) -> int:
        """Number of passes of the final optimisation in the settings."""
        return self.config.final.passes

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the views."""
        return [*super().constant_tensors(), *self.views.constant_tensors()]

    def state_dict(self) -> dict[str, Any]:
        """The state of any mapper, the TSDF, and the views that are optimised."""
        return super().state_dict() | {"views": self.views.state_dict()}

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.views.load_state_dict(state["views"], self.config.base, self.device)

    def _undo(self) -> Callable[[], None]:
        undo, views = super()._undo(), self.views.snapshot()

        def undo_all() -> None:
            undo()
            self.views = views.snapshot()

        return undo_all

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure the views are at other poses, and the surface is another one."""
        super()._follow(correction)
        if correction is not None:
            self.views.forget()
            self.forget_discs()

    def _kept(self, frame: Frame) -> Keyframe:
        return Keyframe.of(frame, with_depth=self.training.loss is not None)

    def _look(self, keyframe: Keyframe) -> BasedView:
        return look_at(self.volume, keyframe.to(self.device), self.config.base)

    def _renew_views(self, now: BasedView | None, *, in_window: bool) -> None:
        """Look again at the views whose turn it is; ``now``: this frame, which becomes one of them if ``in_window``."""
        self._kept_bases = {}
        views = self.views
        if in_window and now is not None and bool((now.seen_depth_m > 0).any()):
            views.add_frame(now)
        if not self.config.schedule.spread and views.steps_in(self.n_frames):
            views.look_again(self._look)
        n, n_new = views.recalls_in(self.n_frames), views.new_in(self.n_frames)
        views.recall(self.keyframes, self._look, self.random.keyframes, n, n_new)

    def _prune(self) -> None:
        """Remove Gaussians that have become too small, too large or transparent; a NaN counts as such."""
        limits, params = self.config.residual, self.gaussians.params
        radius_m = params.log_scale.amax(dim=1).exp()
        kept = (radius_m >= limits.min_radius_m) & (radius_m <= limits.max_radius_m)
        kept &= params.opacity_logit.sigmoid() >= limits.min_opacity
        if not bool(kept.all()):
            self.gaussians.keep(kept)

    def _restart_adam(self) -> None:
        """Forget all moments and the number of steps."""
        for moments in (self.gaussians.exp_avg, self.gaussians.exp_avg_sq):
            for column in vars(moments).values():
                column.zero_()
        self.gaussians.birth_step.fill_(self.gaussians.step_count)

    def _optimise(self, context: SeedContext) -> tuple[list[float], list[float]]:
        """The steps of this frame, each on one of the views. Returns their losses and PSNRs."""
        n = self.views.steps_in(self.n_frames) if len(self.views) and len(self.gaussians) else 0
        self.after_steps.frame_begins(context, n)
        steps = [self._optimise_view(self.views.next_view(self.random.keyframes)) for _ in range(n)]
        if not steps:
            return [], []
        losses, errors = torch.stack([torch.stack(step) for step in steps], dim=1).tolist()
        return losses, [psnr_from_mse(mse) for mse in errors]

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe after the scan; each pass ends as a burst does, with the removal of rows."""
        view = self._kept_bases.get(i)
        if view is None:
            view = look_at(self.volume, self.keyframes[i].to(self.device), self.config.base, full=True)
            size = sum(x.nbytes for x in (*vars(view.below.base).values(), view.seen_rgb, view.seen_depth_m))
            if (len(self._kept_bases) + 1) * size <= KEPT_BASES_BYTES:
                self._kept_bases[i] = view
        loss = self._optimise_view(view, self.config.final.ssim_weight)[0]
        if not self.passes.queue:
            self._prune()
        return loss

    @observed
    def _optimise_view(self, view: BasedView, ssim_weight: float = 0.0) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """One gradient step on one view. Returns loss and MSE before it; the surface is held fixed."""
        self.guard.may_stop()
        keyframe, below, params = view.keyframe, view.below, self.gaussians.params
        camera, T_WC, target = keyframe.camera, keyframe.T_WC, keyframe.rgb
        watched = self.after_steps.watch(self.gaussians, camera, T_WC)
        output, saved = render_over_base(params, camera, T_WC, below.base, behind_m=below.behind_m)
        of_pixels = l2_mse_vjp if self.config.residual.loss == "l2" else l1_mse_vjp
        pixels = of_pixels(output.rgb, target)
        loss, v_rgb = pixels.value, pixels.v_rgb
        if self.training.loss is not None:
            given = self.training.view_loss(output.as_render_output(below.base), keyframe, with_depth=False)
            loss, v_rgb = given.value, given.v_rgb
        elif ssim_weight > 0:
            structural, v_structural = dssim_vjp(output.rgb, target)
            loss = (1 - ssim_weight) * loss + ssim_weight * structural
            v_rgb = (1 - ssim_weight) * v_rgb + ssim_weight * v_structural
        gradients = render_over_base_vjp(saved, v_rgb, **({} if watched is None else watched.outputs))
        adam_step(self.gaussians, gradients, self.config.residual.adam, self.training.optimiser)
        if watched is not None:
            watched = self.after_steps.add_up(self.gaussians, watched, camera)
            self.after_steps(self, watched, keyframe, loss, output.rgb)
        return loss, pixels.mse
