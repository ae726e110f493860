"""GSFusion (Wei & Leutenegger 2024): TSDF fusion and Gaussian splatting, one frame at a time, in
the paper's order."""

import bisect
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..backends import observed, piece
from ..config import GSFusionConfig, OptimConfig, gsfusion, gsfusion_fidelities, gsfusion_fidelity
from ..errors import ArgumentError
from ..gaussians import GaussianModel
from ..large_maps import MapPart
from ..optim import (
    Keyframe,
    Loss,
    PictureVjp,
    Regulariser,
    TrainingView,
    ViewLoss,
    ViewStep,
    add_penalties_,
    depth_l1,
    depth_l1_vjp,
    dssim_vjp,
    expected_depth_loss,
    l1_mse_vjp,
)
from ..render import render_forward, render_vjp
from ..render.constants import NEAR_PLANE_M
from ..render.near_plane import near_plane_m
from ..seeding import SeedContext, rule_name
from ..tsdf import FusedView, fuse_frame_
from ..types import Camera, Frame, GaussianParams, RenderOutput
from .description import SystemDescription
from .gsfusion_reports import GSFusionFiles, GSFusionReports
from .keyframe_fits import KeyframeFits
from .rule_calls import context_of
from .step_report import StepReport, as_floats
from .tsdf_mapping import TsdfMapping
from .view_steps import step_on_view


class GSFusion(TsdfMapping):
    """GSFusion: its two maps are ``volume`` (TSDF) and ``gaussians``.

    GSFusion as published takes the poses as given; ``config.tracking.poses = "tracked"`` aligns
    each frame to the TSDF by RTG-SLAM's ICP instead. Settings and published presets:
    ``gsfusion_nb.config.gsfusion``.
    """

    description = SystemDescription(
        title="GSFusion",
        fidelities=gsfusion_fidelities,
        fidelity_of=gsfusion_fidelity,
        panels=("input", "render", "error", "quadtree_seeds"),
        memory_savers=(
            "a larger seeding.quadtree_threshold",
            "larger voxels (tsdf.voxel_size_m)",
        ),
    )
    config_type = GSFusionConfig
    preset = staticmethod(gsfusion)
    files_type = GSFusionFiles
    reports_type = GSFusionReports

    config: GSFusionConfig
    gaussians: GaussianModel

    def __init__(self, *args: Any, **options: Any):
        """Raises ``ValueError`` for a rule that is asked in keyframes only, without
        ``keyframe_every``."""
        super().__init__(*args, **options)
        if self.rule_in_use.when.only_keyframes and not self.config.keyframe_every:
            raise ArgumentError(
                f"the seeding rule {rule_name(self.rule)!r} is asked in keyframes only, and with "
                "keyframe_every = 0 a "
                "frame becomes a keyframe by its seeds; set keyframe_every, such as 5"
            )
        optim = self.config.optim
        self.fits = (
            KeyframeFits(optim, self.trajectory)
            if optim.refine_poses or optim.fit_exposure
            else None
        )
        """What the passes after the scan fit to keyframes besides the Gaussians, if anything."""
        if self.fits is not None:
            self.transaction.protect(self.trajectory.undo_of_refinement)
        self.camera: Camera | None = None
        """Of the last frame; None before the first, and after a resume until the next."""

    def map_frame(self, frame: Frame) -> StepReport:
        """Fuse, propose seeds, append, optimise (paper Fig. 2, section III-B).

        In the paper the frame is fused before the seeding rule runs. Here the frame is fused last,
        because that cannot be undone. The rule sees a preview of the fused volume (``FusedView``),
        with the same values, and the optimisation does not read the volume, so the maps are those
        of the paper's order.
        """
        self.camera = frame.camera
        with self.clock("tsdf"):
            missing = self.make_room(frame)  # III-B.1, the blocks
        with self.clock("seeding"), self.clock.operation("quadtree", of="seeding"):
            preview = FusedView(self.volume, frame, missing)
            context = self.seed_context(frame, volume=preview)
            seeds = self.propose_seeds(context)  # III-B.2, Eq. 10
        with self.transaction.changes():
            self.parts.append(seeds, frame.index)
            is_keyframe, n_steps, n_revisits = self._plan(frame, len(seeds))  # III-B.3
            if is_keyframe or self.config.keep_all_frames:
                has_loss = self.training.loss is not None
                compares_depth = has_loss or self.config.optim.depth_weight > 0
                self.keyframes.append(frame, with_depth=compares_depth, with_extra=has_loss)
            with self.clock("optimise"):
                steps = self._optimise_online(context, n_steps, n_revisits)  # Eq. 12
        with self.clock("tsdf"):
            self.volume.allocate_missing(missing)
            fuse_frame_(self.volume, frame)  # III-B.1, Eq. 6-9
        return self.reports.of_frame(frame, seeds, is_keyframe, steps[:n_steps], n_steps=len(steps))

    def seed_context(self, frame: Frame, **inputs: Any) -> SeedContext:
        """What a seeding rule sees of this frame; by default after it was fused into the TSDF."""
        return context_of(self, frame, **{"volume": self.volume} | inputs)

    def is_next_keyframe(self, frame: Frame) -> bool | None:
        """Whether this frame, mapped next, becomes a keyframe; None if that depends on the number
        of its seeds."""
        every = self.config.keyframe_every
        gap = self.config.keyframe_max_gap
        if every:
            return self.n_frames % every == 0
        indices = self.trajectory.frame_indices
        is_overdue = False
        if gap and len(self.keyframes):
            n_since = len(indices) - bisect.bisect_left(indices, self.keyframes[-1].index)
            is_overdue = n_since >= gap
        return True if is_overdue and not self._seen_before(frame) else None

    @property
    def row_optim(self) -> OptimConfig:
        """Learning rates of the Gaussians."""
        return self.config.optim

    @property
    def n_passes(self) -> int:
        """Number of passes of the global optimisation in the settings."""
        return self.config.optim.global_iterations

    def _plan(self, frame: Frame, n_seeds: int) -> tuple[bool, int, int]:
        """``plan_frame`` by the settings; where its seeds do not decide whether the frame is a
        keyframe, ``plan_of_kind``."""
        optim = self.config.optim
        numbers = (
            len(self.keyframes) + self.config.keep_all_frames,
            optim.keyframe_iterations,
            optim.frame_iterations,
            optim.random_keyframe_iterations,
        )
        is_keyframe = self.is_next_keyframe(frame)
        if is_keyframe is None:
            return plan_frame(n_seeds, *numbers, self.config.keyframe_min_seeds)
        return plan_of_kind(is_keyframe, *numbers)

    def _optimise_online(
        self,
        context: SeedContext,
        n: int,
        n_revisits: int,
    ) -> list[list[float]]:
        """``n`` steps on the frame, then some on random keyframes to avoid forgetting (III-B.3).

        Returns loss and mean squared error before each step.
        """
        if len(self.gaussians) == 0:
            return []
        earlier = self.keyframes.draw(n_revisits, self.random.keyframes)
        self.after_steps.frame_begins(context, n + len(earlier))
        views = [*[context.frame] * n, *earlier]
        return as_floats(
            [self._optimise_view(view, self.config.optim.online_ssim_weight) for view in views]
        )

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe after the scan."""
        step = self._optimise_view(self.keyframes[i], self.config.optim.ssim_weight, fits=True)
        if self.fits is not None and not self.passes.queue:
            self.fits.end_pass(self.keyframes, self.gaussians)
        return step.loss

    @observed
    def _optimise_view(
        self, view: Frame | Keyframe, ssim_weight: float = 0.0, fits: bool = False
    ) -> ViewStep:
        """One gradient step on one view. As published, the loss is only L1 online.

        With ``fits`` the view is a keyframe whose pose and exposure are fitted, too, where the
        settings say so.
        """
        self.guard.may_stop()
        view = view.to(self.device)
        part = self.parts.in_view(view)
        target_rgb = view.rgb
        loss: Loss = partial(
            self._loss, part=part, view=view, target_rgb=target_rgb, ssim_weight=ssim_weight
        )
        fit = self.fits if fits else None
        keyframe: Any = view  # where poses and exposures are fitted
        if fit is not None:
            loss = fit.exposed_loss(loss, self.keyframes, keyframe, target_rgb)
        drawn = partial(draw, view=view, near_m=near_plane_m(self.config))
        step, statistics = step_on_view(self, view, part, drawn, loss, self._regulariser(part))
        if fit is not None:
            fit.move(self.keyframes, keyframe, target_rgb)
        self.after_steps.edit(self, statistics, view, step, target_rgb)
        return step

    def _regulariser(self, part: MapPart) -> Regulariser | None:
        """The penalties on Gaussians, if the settings ask for any."""
        optim = self.config.optim
        weights = {
            "isotropy": optim.isotropy_weight,
            "scale": optim.scale_weight,
            "opacity": optim.opacity_weight,
        }
        if not any(weights.values()):
            return None
        return lambda gradients: add_penalties_(gradients, part.params, **weights)

    def _loss(
        self,
        picture: RenderOutput,
        part: MapPart,
        view: Frame | Keyframe,
        target_rgb: Float[Tensor, "H W 3"],
        ssim_weight: float,
    ) -> tuple[ViewLoss, Float[Tensor, ""]]:
        """L1 (Eq. 12), with D-SSIM and depth where the settings say so, or the given loss; and the
        MSE."""
        pixels = l1_mse_vjp(picture.rgb, target_rgb)
        optim = self.config.optim
        if self.training.loss is not None:
            target = TrainingView.of(view, rgb=target_rgb)
            return self.training.view_loss(picture, target, part.params), pixels.mse
        loss = pixels.value
        v_rgb = pixels.v_rgb
        v_depth_m = None
        if ssim_weight > 0:
            structural, v_structural = dssim_vjp(picture.rgb, target_rgb)
            loss = (1 - ssim_weight) * loss + ssim_weight * structural
            v_rgb = (1 - ssim_weight) * v_rgb + ssim_weight * v_structural
        v_alpha = None
        if optim.depth_weight > 0 and view.depth_m is not None:
            depth_loss, v_depth_m, v_alpha = _depth_loss(picture, view.depth_m, self.config)
            loss = loss + depth_loss
        return ViewLoss(value=loss, v_rgb=v_rgb, v_depth_m=v_depth_m, v_alpha=v_alpha), pixels.mse


def _depth_loss(
    picture: RenderOutput, measured_m: Float[Tensor, "H W"], config: GSFusionConfig
) -> tuple[Float[Tensor, ""], Float[Tensor, "H W"], Float[Tensor, "H W"] | None]:
    """The term of the depth with its weight, and its gradient with respect to the blended depth and
    to alpha; None is zero."""
    optim = config.optim
    weight = optim.depth_weight
    if optim.depth_over_alpha:
        loss = expected_depth_loss(
            picture.depth_m,
            picture.alpha,
            measured_m,
            optim.depth_coverage,
            config.tsdf.far_m,
            weight,
        )
        return loss.value, loss.v_depth_m, loss.v_alpha
    value = weight * depth_l1(picture.depth_m, measured_m)
    return value, depth_l1_vjp(picture.depth_m, measured_m, weight), None


def draw(
    params: GaussianParams, view: Frame | Keyframe, near_m: float = NEAR_PLANE_M
) -> tuple[RenderOutput, PictureVjp]:
    """The Gaussians as the camera of a view sees them beyond ``near_m``, and the gradient."""
    output, saved = render_forward(
        params, view.camera, view.T_WC, with_indices=False, near_m=near_m
    )
    return output, partial(render_vjp, saved)


@piece
def plan_frame(
    n_seeds: int,
    n_keyframes: int,
    keyframe_steps: int,
    frame_steps: int,
    revisits: int,
    min_seeds: int,
) -> tuple[bool, int, int]:
    """Whether a frame is a keyframe, its gradient steps, and how many random keyframes are
    revisited (III-B.3).

    Args:
        n_seeds: New Gaussians of the frame.
        n_keyframes: Keyframes that can be revisited.
        keyframe_steps, frame_steps: Steps on a keyframe, m; on another frame, n.
        revisits: Largest number of revisits, after a frame that is not a keyframe.
        min_seeds: A keyframe has more new Gaussians than this.
    """
    return plan_of_kind(n_seeds > min_seeds, n_keyframes, keyframe_steps, frame_steps, revisits)


def plan_of_kind(
    is_keyframe: bool, n_keyframes: int, keyframe_steps: int, frame_steps: int, revisits: int
) -> tuple[bool, int, int]:
    """``plan_frame`` of a frame of which it is decided whether it is a keyframe."""
    if is_keyframe:
        return True, keyframe_steps, 0
    return False, frame_steps, min(revisits, n_keyframes)
