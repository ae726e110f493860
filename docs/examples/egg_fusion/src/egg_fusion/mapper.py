"""EGG-Fusion's frame step: fuse what is measured into the surfels, add new ones, optimise the
window."""

import dataclasses
from typing import Any

import cv2
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsfusion_nb.errors import ArgumentError
from gsfusion_nb.gaussians import restart_optimiser
from gsfusion_nb.geometry import depth_to_normals, depth_to_points, project, se3
from gsfusion_nb.mapping import Mapper, StepReport, SystemDescription, as_floats, disc_mesh
from gsfusion_nb.optim import Keyframe, ViewStep, adam_step
from gsfusion_nb.types import Camera, Frame, GaussianParams, Mesh, Seeds

from .config import EggConfig, egg_fusion
from .picture import SurfelPicture, draw
from .surfel_filter import SurfelState, fused, information, normals_of, turned

WINDOW = 3
"""Frames of the window."""


class EggFusion(Mapper):
    """The mapper; its map is ``gaussians``, whose rows remember their information."""

    description = SystemDescription(title="EGG-Fusion", gaussians_are_discs=True, needs_depth=True)
    config_type = EggConfig
    preset = egg_fusion
    config: EggConfig

    def __init__(self, *args: Any, **options: Any):
        """Raises ``ValueError`` for a loss of the user's, and for a rule that edits the map after
        steps."""
        super().__init__(*args, **options)
        if self.training.loss is not None or self.after_steps.edits:
            raise ArgumentError(
                "EGG-Fusion has its own loss, and lets no seeding rule edit the map after a step; "
                "leave out the loss, or take another rule"
            )

    @property
    def n_passes(self) -> int:
        return self.config.final_passes

    @property
    def camera(self) -> Camera:
        """Of the first keyframe."""
        return self.keyframes[0].camera

    @property
    def w_p(self) -> Float[Tensor, " N"]:
        """Information of the centres."""
        return self.gaussians.row_memory("w_p")

    @property
    def w_n(self) -> Float[Tensor, " N"]:
        """Information of the normals."""
        return self.gaussians.row_memory("w_n")

    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfelPicture:
        """Colour, depth and normals of the surfels."""
        with torch.no_grad():
            return draw(self.parts.params_now(), camera, T_WC.to(self.device))

    def mesh(self) -> Mesh:
        """Surface of rendered depth, fused into a TSDF."""
        mesh, self.mesh_share = disc_mesh(self)
        return mesh

    def map_frame(self, frame: Frame) -> StepReport:
        config = self.config
        with self.clock("prepare"):
            frame = smoothed(frame)
        with self.clock("seeding"):
            context = self.seed_context(frame)
            seeds = self.propose_seeds(context)
        joins = self.n_frames % config.window_every == 0
        n_steps = config.round_steps if self.n_frames % config.round_every == 0 else 0
        with self.transaction.changes(undoable=True):
            with self.clock("fusion"):
                n_fused = self._fuse(frame)
            self.parts.append(seeds, frame.index)
            self._begin_states(seeds, frame)
            if joins:
                self.keyframes.append(frame, with_depth=True)
            with self.clock("optimise"):
                steps = self._round(n_steps if self.n_frames else config.first_steps)
        is_stable = self.w_p + self.w_n > config.stable_information
        counts = {"fused": n_fused, "stable": int(is_stable.sum())}
        return self.reports.of_frame(frame, seeds, joins, as_floats(steps), counts=counts)

    def _fuse(self, frame: Frame) -> int:
        """Fuse the frame into the surfels that it shows. Returns their number."""
        if not len(self.gaussians):
            return 0
        self.gaussians.undo_log.will_change()
        params = self.gaussians.params
        rows, u, v = self._seen_rows(frame)
        T_WC = frame.T_WC
        state = SurfelState(
            xyz_W=params.xyz_W[rows],
            normal_W=normals_of(params.quat[rows]),
            w_p=self.w_p[rows],
            w_n=self.w_n[rows],
        )
        points_W = se3.apply(T_WC, depth_to_points(frame.camera, frame.depth_m)[v, u])
        normal_W = se3.rotate(T_WC, depth_to_normals(frame.camera, frame.depth_m)[v, u])
        after = fused(
            state,
            points_W,
            normal_W,
            frame.depth_m[v, u],
            alpha_p=self.config.alpha_p,
            alpha_n=self.config.alpha_n,
        )
        params.xyz_W[rows] = after.xyz_W
        params.quat[rows] = turned(params.quat[rows], state.normal_W, after.normal_W)
        self.w_p[rows] = after.w_p
        self.w_n[rows] = after.w_n
        self.parts.boxes.forget()
        self.parts.forget()
        return len(rows)

    def _seen_rows(
        self, frame: Frame
    ) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"], Int[Tensor, " M"]]:
        """Rows that the frame observes, and the column and row of their pixels (A.4, Eq. 18-19)."""
        params = self.gaussians.params
        camera = frame.camera
        T_CW = se3.inverse(frame.T_WC)
        p = se3.apply(T_CW, params.xyz_W)
        uv = project(camera, p).nan_to_num(-1)
        size = uv.new_tensor([camera.width, camera.height])
        is_inside = ((uv >= 0) & (uv < size)).all(dim=1) & (p[:, 2] > 0)
        faces = se3.rotate(T_CW, normals_of(params.quat))[:, 2] < 0
        rows = (is_inside & faces).nonzero()[:, 0]
        u, v = uv[rows].long().unbind(dim=1)
        z = p[rows, 2]
        within = self.config.fuse_within_m
        seen_m = self.surface(camera, frame.T_WC).depth_m[v, u]
        has_normal = (depth_to_normals(camera, frame.depth_m)[v, u] != 0).any(dim=1)
        fits = ((z - seen_m).abs() < within) & ((z - frame.depth_m[v, u]).abs() < within)
        fits &= has_normal
        return rows[fits], u[fits], v[fits]

    def _begin_states(self, seeds: Seeds, frame: Frame) -> None:
        """The information of new surfels: that of one observation."""
        depth_m = se3.apply(se3.inverse(frame.T_WC), seeds.xyz_W)[:, 2]
        new = slice(len(self.gaussians) - len(seeds), None)
        self.w_p[new] = information(depth_m, self.config.alpha_p)
        self.w_n[new] = information(depth_m, self.config.alpha_n)

    def _round(self, n: int) -> list[ViewStep]:
        """``n`` steps on views of the window, with a fresh Adam."""
        if not n or not len(self.gaussians):
            return []
        self.gaussians.undo_log.will_change()
        restart_optimiser(self.gaussians)
        anchor = GaussianParams(
            **{name: x.clone() for name, x in vars(self.gaussians.params).items()}
        )
        views = [self.keyframes[i] for i in range(len(self.keyframes))][-WINDOW:]
        draws = torch.randint(len(views), (n,), generator=self.random.keyframes)
        return [self._step(views[i], anchor) for i in draws.tolist()]

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        return self._step(self.keyframes[i]).loss

    def _step(self, view: Keyframe, anchor: GaussianParams | None = None) -> ViewStep:
        """One step of Adam on a view; towards the filtered state, if it is given (Eq. 9-11)."""
        self.guard.may_stop()
        view = view.to(self.device)
        part = self.parts.in_view(view)
        columns = {name: x.detach().clone() for name, x in vars(part.params).items()}
        leaves = GaussianParams(**{name: x.requires_grad_() for name, x in columns.items()})
        rgb = view.rgb
        with torch.enable_grad():
            picture = draw(leaves, view.camera, view.T_WC)
            loss = self._loss(picture, view, rgb)
            if anchor is not None:
                loss = loss + self._away_from_state(leaves, anchor[part.rows])
            loss.backward()
        gradients = {
            name: torch.zeros_like(x) if x.grad is None else x.grad for name, x in columns.items()
        }
        gradients["log_scale"][:, 2] = 0.0  # surfels stay flat
        adam_step(part, GaussianParams(**gradients), self.config.optim, self.training.optimiser)
        self.lost.stepped(part.params)
        part.write_back()
        mse = (picture.rgb.detach().clamp(0, 1) - rgb).square().mean()
        return ViewStep(loss=loss.detach(), mse=mse, rgb=picture.rgb.detach())

    def _loss(self, picture: SurfelPicture, view: Keyframe, rgb: Tensor) -> Tensor:
        """Colour, depth and normal, means over the pixels with a measured and a rendered
        surface."""
        assert view.depth_m is not None
        normal_C = depth_to_normals(view.camera, view.depth_m)
        normal_W = se3.rotate(view.T_WC, normal_C)
        counts = (normal_C != 0).any(dim=-1)
        both = counts & (picture.depth_m.detach() > 0)
        colour = (picture.rgb - rgb).abs()[counts].sum() / (3 * counts.sum().clamp_min(1))
        n = both.sum().clamp_min(1)
        depth = (picture.depth_m - view.depth_m).abs()[both].sum() / n
        turn = (1 - (picture.normal_W * normal_W).sum(dim=-1)).abs()[both].sum() / n
        return colour + self.config.depth_weight * depth + self.config.normal_weight * turn

    def _away_from_state(self, params: GaussianParams, anchor: GaussianParams) -> Tensor:
        """How far centres and normals are from where the round began."""
        moved = (params.xyz_W - anchor.xyz_W).square().sum().add(1e-20).sqrt()
        cosine = (normals_of(params.quat) * normals_of(anchor.quat)).sum(dim=1)
        turn = (1 - cosine).abs().mean()
        return self.config.state_weight * (moved + self.config.state_normal_weight * turn)


def smoothed(frame: Frame) -> Frame:
    """The frame with a bilateral filter on its depth (13 pixels, 3 cm); missing depth stays."""
    depth = frame.depth_m.cpu().numpy()
    smooth = torch.from_numpy(cv2.bilateralFilter(depth, 13, 0.03, 4.5)).to(frame.depth_m)
    return dataclasses.replace(frame, depth_m=torch.where(frame.depth_m > 0, smooth, 0.0))
