"""SplaTAM in one file: a map of round Gaussians that is tracked, densified and optimised by its
silhouette.

    gsfusion-nb map room --system splatam_like.py:SplatamLike

Written from the paper (Keetha et al. 2024, sections 3.1 to 3.3), not from its code. Other than
there: a pose moves by a twist, at rates chosen here; a TSDF beside the map serves for its mesh, and
to locate held-out views. Neither changes the Gaussians.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsfusion_nb import config as settings
from gsfusion_nb import mapping, optim
from gsfusion_nb.geometry import depth_to_points, project, se3
from gsfusion_nb.geometry.spherical_harmonics import SH_C0
from gsfusion_nb.render import render_autograd
from gsfusion_nb.render.near_plane import near_plane_m
from gsfusion_nb.tracking import TrackingLostError
from gsfusion_nb.tsdf import fuse_frame_
from gsfusion_nb.types import Frame, GaussianParams, RenderOutput

PRUNED_AFTER = (0, 20)
"""Gradient steps of a frame after which Gaussians are removed."""
SURFACE = settings.TsdfConfig(voxel_size_m=0.02)
DENSIFICATION = settings.SeedingConfig(rule="splatam")
"""One pixel each where the silhouette is below 0.5, or the frame is in front of the map (Eq. 9)."""
TRACKED = settings.TrackingConfig(poses="tracked")
RATES = settings.OptimConfig(
    lr_xyz=1e-4,
    lr_sh_dc=2.5e-3 / SH_C0,
    lr_opacity_logit=0.05,
    lr_log_scale=1e-3,
    lr_quat=0.0,
    adam_steps="per_row",
    global_iterations=0,
)
ROOM = {"data": {"width": 160, "height": 120}, "track_depth_weight": 0.02}
"""Of the built-in scene."""


@dataclass(frozen=True, kw_only=True)
class SplatamConfig(settings.SystemConfig):
    """All settings of a run, except where the data is."""

    tsdf: settings.TsdfConfig = SURFACE
    seeding: settings.SeedingConfig = DENSIFICATION
    tracking: settings.TrackingConfig = TRACKED
    optim: settings.OptimConfig = RATES
    sh_degree: int = 0
    steps: int = 60
    """Gradient steps on the map in each frame. Larger: sharper, slower. Published: 60."""
    track_steps: int = 40
    """Gradient steps on the pose of each frame. Larger: tolerates faster motion, slower."""
    track_rate: float = 2e-3
    """Adam's rate of the twist of a pose, metres and radians. Usual: 5e-4 to 5e-3."""
    track_depth_weight: float = 1.0
    """Weight of the mean depth error in metres beside half of the colour error, in tracking. A
    round Gaussian of one pixel is drawn half of its size too near, so small pictures need less."""
    min_silhouette: float = 0.99
    """Only pixels with a larger accumulated opacity count in tracking. Published: 0.99."""
    keyframe_every: int = 5
    """Every n-th mapped frame is a keyframe. Published: 5."""
    views: int = 8
    """Keyframes that overlap most with a frame and share its steps. Larger: less forgetting."""


class SplatamLike(mapping.TsdfMapping):
    """The mapper; its map is ``gaussians``, whose three scales are always equal."""

    description = mapping.SystemDescription(title="SplaTAM-like", needs_depth=True)
    config_type = SplatamConfig
    preset = settings.Presets.of(SplatamConfig, tum={"steps": 30}, room=ROOM)
    config: SplatamConfig

    @property
    def n_passes(self) -> int:
        return self.config.optim.global_iterations

    @property
    def row_optim(self) -> settings.OptimConfig:
        return self.config.optim

    def track_frame(self, frame: Frame) -> Frame:
        return self.localiser.locate_by(self.find_pose, frame)

    def find_pose(self, frame: Frame, T_predicted: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """The pose whose picture fits best where the map is complete (Keetha et al., Eq. 8)."""
        params = self.parts.params_now()
        xi = torch.zeros(6, device=self.device, requires_grad=True)
        adam = torch.optim.Adam([xi], lr=self.config.track_rate)
        best = (torch.inf, T_predicted)
        for _ in range(self.config.track_steps):
            with torch.enable_grad():
                T_WC = T_predicted @ se3.exp(xi)
                near_m = near_plane_m(self.config)
                seen = render_autograd(params, frame.camera, T_WC, near_m=near_m)
                counts = (seen.alpha > self.config.min_silhouette) & (frame.depth_m > 0)
                if not counts.any():
                    raise TrackingLostError("the map shows nothing there")
                depth = (seen.depth_m - frame.depth_m).abs()[counts].mean()
                colour = (seen.rgb - frame.rgb).abs()[counts].mean()
                loss = self.config.track_depth_weight * depth + 0.5 * colour
            best = min(best, (float(loss.detach()), T_WC.detach()), key=lambda trial: trial[0])
            adam.zero_grad()
            loss.backward()
            adam.step()
        return best[1]

    def map_frame(self, frame: Frame) -> mapping.StepReport:
        with self.clock("tsdf"):
            missing = self.make_room(frame)
        with self.clock("seeding"):
            context = self.seed_context(frame, volume=self.volume)
            seeds = self.propose_seeds(context)  # Eq. 9
        is_keyframe = self.n_frames % self.config.keyframe_every == 0
        with self.transaction.changes(undoable=True):
            self.parts.append(seeds, frame.index)
            views = [frame, *self.overlapping(frame)]
            if is_keyframe:
                self.keyframes.append(frame, with_depth=True)
            self.after_steps.frame_begins(context, self.config.steps)
            with self.clock("optimise"):
                steps = [self._optimise(views, i) for i in range(self.config.steps)]
        with self.clock("tsdf"):
            self.volume.allocate_missing(missing)
            fuse_frame_(self.volume, frame)
        return self.reports.of_frame(frame, seeds, is_keyframe, mapping.as_floats(steps))

    def overlapping(self, frame: Frame) -> list[optim.Keyframe]:
        """The keyframes that show most of the frame's points (section 3.3)."""
        xyz_C = depth_to_points(frame.camera, frame.depth_m)[frame.depth_m > 0][::16]
        xyz_W = se3.apply(frame.T_WC, xyz_C)
        shares = []
        for i, keyframe in enumerate(self.keyframes):
            xyz_C = se3.apply(se3.inverse(keyframe.T_WC.to(xyz_W)), xyz_W)
            uv = project(keyframe.camera, xyz_C)
            size = uv.new_tensor([keyframe.camera.width, keyframe.camera.height])
            is_inside = ((uv >= 0) & (uv < size)).all(dim=1) & (xyz_C[:, 2] > 0)
            shares.append((-float(is_inside.float().mean()), i))
        return [self.keyframes[i] for share, i in sorted(shares)[: self.config.views] if share]

    def _optimise(self, views: list[Any], i: int) -> optim.ViewStep:
        """The i-th step of a frame: on the frame itself, or on one of its keyframes."""
        draws = torch.randint(len(views), (), generator=self.random.keyframes)
        step = self._step(views[int(draws) if i % 2 else 0])
        if i in PRUNED_AFTER:
            self._prune()
        return step

    def _prune(self) -> None:
        """Remove what is transparent, or larger than a tenth of the scene's radius: a third of the
        largest depth of the first frame."""
        self.parts.take_missed_steps()
        first_depth_m = self.keyframes[0].depth_m
        assert first_depth_m is not None
        model = self.gaussians
        is_useful = (model.opacity >= 0.005) & (model.scale_m[:, 0] <= first_depth_m.max() / 30)
        if not is_useful.all():
            model.undo_log.will_change()
            model.keep(is_useful)

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        return self._step(self.keyframes[i]).loss

    def _step(self, view: Frame | optim.Keyframe) -> optim.ViewStep:
        self.guard.may_stop()
        view = view.to(self.device)
        part = self.parts.in_view(view)
        loss = partial(self._loss, view=view)
        drawn = partial(mapping.draw, view=view, near_m=near_plane_m(self.config))
        step, statistics = mapping.step_on_view(self, view, part, drawn, loss, tie_scales)
        self.after_steps.edit(self, statistics, view, step, view.rgb)
        return step

    def _loss(self, picture: RenderOutput, view: Any) -> tuple[optim.ViewLoss, Tensor]:
        """Depth L1 + 0.5 (0.8 colour L1 + 0.2 D-SSIM), and the mean squared error."""
        pixels = optim.l1_mse_vjp(picture.rgb, view.rgb)
        if self.training.loss is not None:
            return self.training.view_loss(picture, optim.TrainingView.of(view)), pixels.mse
        structural, v_structural = optim.dssim_vjp(picture.rgb, view.rgb)
        depth = optim.depth_l1(picture.depth_m, view.depth_m)
        value = depth + 0.4 * pixels.value + 0.1 * structural
        v_rgb = 0.4 * pixels.v_rgb + 0.1 * v_structural
        v_depth_m = optim.depth_l1_vjp(picture.depth_m, view.depth_m, 1.0)
        return optim.ViewLoss(value=value, v_rgb=v_rgb, v_depth_m=v_depth_m), pixels.mse


def tie_scales(gradients: GaussianParams) -> float:
    """One scale for each Gaussian: its gradient is the sum of the three. It adds no loss."""
    gradients.log_scale[:] = gradients.log_scale.sum(dim=1, keepdim=True)
    return 0.0
