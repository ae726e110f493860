"""RTG-SLAM (Peng et al. 2024): compact Gaussians, optimised while unstable, frame by frame in the
paper's order."""

import dataclasses
import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import runs_learners_code
from ..config import RtgSlamConfig, rtg_slam, rtg_slam_fidelities, rtg_slam_fidelity
from ..gaussians import STABLE, SurfelModel, Transitions, fuse_with_history
from ..gaussians.surfels import change_states, count_errors, count_views, state_counts
from ..geometry import se3
from ..large_maps import drawn_in_part
from ..optim import Keyframe, TrainingView, ViewStep
from ..render import (
    SurfaceView,
    rows_in_view,
    view_surface,
)
from ..seeding import DiscInputs, SeedContext, disc_view
from ..tracking import Correction
from ..types import ALL_ROWS, Camera, Frame, GaussianParams, MapRows, Mesh
from .after_steps import StepStatistics
from .description import CURVES, SystemDescription
from .disc_files import DiscFiles, disc_mesh
from .disc_states import STATES, DiscReports, n_stable
from .mapper import Mapper
from .step_report import StepReport, psnr_from_mse
from .surfel_optimiser import SurfelOptimiser
from .transaction import Undo

KEYFRAME_DEG = 30.0
KEYFRAME_M = 0.3
"""A frame becomes a keyframe when the camera has turned, or its centre has moved, by this since the
last one."""

WORST_SHARE = 0.4
"""Share of a keyframe's pixels that have a loss in the optimisation over keyframes, those with the
largest colour errors."""

KEYFRAMES_LR_FACTOR = 0.1
"""Learning rates of the optimisation over keyframes as a multiple of the window's; centres do not
move."""

MASKED_BELOW = 0.8
"""If more of the rows in view are unstable, they touch nearly all pixels; finding these then saves
no time."""

LastStep = tuple[int, ViewStep, StepStatistics]
"""Number of its view, the step, and what was collected of it."""


class RTGSLAM(Mapper):
    """RTG-SLAM: its map is ``gaussians``, discs on the surface.

    Settings and published presets: ``gsfusion_nb.config.rtg_slam``.
    """

    description = SystemDescription(
        title="RTG-SLAM",
        fidelities=rtg_slam_fidelities,
        fidelity_of=rtg_slam_fidelity,
        gaussians_are_discs=True,
        needs_depth=True,
        panels=("input", "render", "error", "depth_error", "states", "seed_causes"),
        curves={**CURVES, "stable Gaussians": n_stable},
        states=STATES,
        memory_savers=("a smaller share in seeding.options",),
    )
    config_type = RtgSlamConfig
    preset = staticmethod(rtg_slam)
    model_type = SurfelModel
    files_type = DiscFiles
    reports_type = DiscReports

    config: RtgSlamConfig
    gaussians: SurfelModel

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.camera: Camera | None = None
        self.window: deque[Frame] = deque(maxlen=self.config.window.frames)
        self._final: SurfelOptimiser | None = None
        """The optimiser of the passes after the scan."""
        self.transaction.protect(self._undo_of_window, self._end_log)

    def __repr__(self) -> str:
        counts = ", ".join(
            f"{n:,} {name.replace('_', ' ')}" for name, n in state_counts(self.gaussians).items()
        )
        return f"RTGSLAM({self.n_frames} frames, {len(self.gaussians):,} Gaussians ({counts}))"

    def map_frame(self, frame: Frame) -> StepReport:
        """Propose seeds, append, optimise the window and the keyframes, change states (paper Fig.
        2, section 3.2)."""
        with self.clock("seeding"):
            context = self.seed_context(frame)
            before = _psnr_db(disc_view(context).rgb, frame) if len(self.gaussians) else math.nan
            seeds = self.propose_seeds(context)  # RTG-SLAM Eq. 6
        is_keyframe = self.is_next_keyframe(frame)
        window_is_due = self._window_is_due(is_keyframe)
        keyframes_are_due = is_keyframe and self.n_frames > 0
        with self.transaction.changes(undoable=window_is_due or keyframes_are_due):
            self.parts.append(seeds, frame.index)
            self._begin(context, is_keyframe, window_is_due, keyframes_are_due)
            with self.clock("optimise"):
                losses = self._optimise_window() if window_is_due else []  # RTG-SLAM Eq. 7-9
            with self.clock("keyframes"):
                n_steps = self._optimise_keyframes() if keyframes_are_due else 0
            self.guard.may_stop()
            self.remove_lost()
            with self.clock("states"):
                after, transitions = self._manage_states(frame)
            self.gaussians.clock.advance(self.n_frames + 1)
        return self.reports.of_frame(
            frame,
            seeds,
            is_keyframe,
            losses=tuple(losses),
            n_steps=len(losses) + n_steps,
            psnr_before_db=before,
            psnr_after_db=after,
            counts=state_counts(self.gaussians) | vars(transitions),
        )

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame."""
        return self._context(
            frame,
            system=DiscInputs(discs=self.config.discs),
            near_m=self.config.data.depth_min_m,
        )

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe."""
        if not len(self.keyframes):
            return True
        last = self.keyframes[len(self.keyframes) - 1].T_WC.to(frame.T_WC)
        turned = torch.rad2deg(se3.rotation_angle(last[:3, :3].T @ frame.T_WC[:3, :3]))
        moved = (last[:3, 3] - frame.T_WC[:3, 3]).norm()
        return float(turned) >= KEYFRAME_DEG or float(moved) >= KEYFRAME_M

    def _window_is_due(self, is_keyframe: bool) -> bool:
        replaced = (
            is_keyframe
            and self.config.keyframes.instead_of_window
            and bool(self.gaussians.is_stable.any())
        )
        return not self.n_frames or (
            (self.n_frames + 1) % self.config.window.every_frames == 0 and not replaced
        )

    def _begin(
        self, context: SeedContext, is_keyframe: bool, window: bool, keyframes: bool
    ) -> None:
        """Take the frame of ``context`` into the window, and keep it if it is a keyframe. What will
        be optimised is told to ``after_steps``."""
        self._final = None  # its rows are no longer the map's
        self.window.append(context.frame)
        if is_keyframe:
            self.keyframes.append(context.frame, with_depth=True)
        n_steps = (
            window * self.config.window.iterations + keyframes * self.config.keyframes.iterations
        )
        self.after_steps.frame_begins(context, n_steps)

    def _optimise_window(self) -> list[float]:
        """Optimise the unstable Gaussians against the last frames, then fuse them with the old
        values (Eq. 7-9)."""
        config = self.config.window
        model = self.gaussians
        trained = ~model.is_stable if config.only_unstable else torch.ones_like(model.is_stable)
        seen = self._seen(self.window)
        if not (trained & seen).any():
            return []
        given = {"all_in_view": self.config.all_in_view, "training": self.training}
        optimiser = SurfelOptimiser(
            model, trained, config, self.config.discs, is_in_view=seen, **given
        )
        before = GaussianParams(
            **{name: value.clone() for name, value in vars(optimiser.trained_params).items()}
        )
        masked = config.only_unstable and optimiser.n < MASKED_BELOW * int(seen.sum())
        touched = [
            optimiser.covered_pixels(f.camera, f.T_WC) if masked else None for f in self.window
        ]
        views = [
            TrainingView.of(frame, pixels)
            for frame, pixels in zip(self.window, touched, strict=True)
        ]
        newest_from = config.iterations / 2 if config.draw == "newest_half" else math.inf
        losses, last = self._take_steps(optimiser, views, config.iterations, newest_from)
        was = model.confidence[optimiser.rows]
        most = config.history_max_weight
        now = was + optimiser.colour_steps
        fused = fuse_with_history(
            before, optimiser.trained_params, was, now, history_max_weight=most
        )  # RTG-SLAM Eq. 9
        optimiser.write_back(fused)
        model.confidence[optimiser.rows] = now
        self._edit(self.window, last)
        return torch.stack(losses).tolist() if losses else []

    def _optimise_keyframes(self) -> int:
        """Optimise over the latest and some random keyframes, on the pixels with the largest colour
        errors.

        Returns the number of gradient steps.
        """
        config = self.config.keyframes
        model = self.gaussians
        n = len(self.keyframes)
        latest = list(range(max(0, n - config.latest), n))
        earlier = torch.randperm(n - len(latest), generator=self.random.keyframes)[
            : config.random
        ].tolist()
        chosen = [self.keyframes[i].to(self.device) for i in earlier + latest]
        rows = model.is_stable if config.rows == "stable" else torch.ones_like(model.is_stable)
        seen = self._seen(chosen)
        if not (rows & seen).any():
            return 0
        optimiser = SurfelOptimiser(
            model,
            rows,
            self.config.window,
            self.config.discs,
            is_drawn=rows,
            is_in_view=seen,
            lr_factor=KEYFRAMES_LR_FACTOR,
            move_centres=False,
            all_in_view=self.config.all_in_view,
            training=self.training,
        )
        views = [TrainingView.of(keyframe, self._worst_pixels(keyframe)) for keyframe in chosen]
        _, last = self._take_steps(optimiser, views, config.iterations)
        optimiser.write_back()
        self._edit(chosen, last)
        return config.iterations

    def _take_steps(
        self,
        optimiser: SurfelOptimiser,
        views: list[TrainingView],
        n: int,
        newest_from: float = math.inf,
    ) -> tuple[list[Tensor], LastStep | None]:
        """``n`` gradient steps on views drawn at random, from step ``newest_from`` on only on the
        newest.

        Returns the losses before them; and the number of the view, the loss and what was collected
        of the last step.
        """
        losses = []
        last = None
        for step in range(n):
            self.guard.may_stop()
            i = len(views) - 1 if step >= newest_from else self._draw(len(views))
            view_step, watched = self._step_on(views[i], optimiser)
            losses.append(view_step.loss)
            last = i, view_step, watched
        optimiser.take_missed_steps()
        self.lost.stepped(optimiser.trained_params)
        return losses, last

    def _step_on(
        self, view: TrainingView, optimiser: SurfelOptimiser
    ) -> tuple[ViewStep, StepStatistics]:
        """One step, on copies of rows, and what was collected of it."""
        rows = optimiser.drawn_rows
        watched = self.after_steps.watch(self.gaussians, view, len(rows))
        step = optimiser.step(view, watched.outputs)
        return step, self.after_steps.add_up(self.gaussians, watched, view.camera, rows)

    def _edit(self, sources: Sequence[Frame | Keyframe], last: LastStep | None) -> None:
        """Let the rule edit the map after its rows were written back."""
        if last is not None:
            i, step, watched = last
            self.after_steps.edit(self, watched, sources[i], step)

    def _seen(self, views: Iterable[Frame | Keyframe]) -> Bool[Tensor, " N"]:
        """Rows that any of the views may show."""
        params = self.gaussians.params
        seen = torch.zeros_like(self.gaussians.is_stable)
        for view in views:
            depth_m = None if self.config.all_in_view else view.depth_m
            rows = self.parts.boxes.rows(params, view.camera, view.T_WC, depth_m)
            seen[rows] |= rows_in_view(params[rows], view.camera, view.T_WC)
        return seen

    def _worst_pixels(self, keyframe: Keyframe) -> Bool[Tensor, "H W"]:
        """The pixels with the largest colour errors, a fixed share of the image."""
        view = self.surface(keyframe.camera, keyframe.T_WC, keyframe.farthest_m)
        error = (view.rgb - keyframe.rgb).abs().mean(dim=-1)
        return error >= error.flatten().quantile(1 - WORST_SHARE)

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe, on all pixels and all Gaussians, which all become stable
        at the first step."""
        if self._final is None:
            self.gaussians.will_change()
            self.gaussians.state.fill_(STABLE)
            self._final = self._final_optimiser()
        keyframe = self.keyframes[i].to(self.device)
        step, watched = self._step_on(TrainingView.of(keyframe), self._final)
        self._final.write_back()
        self.lost.stepped(self._final.trained_params)
        self._edit([keyframe], (0, step, watched))
        return step.loss

    def params_now(self, rows: MapRows = ALL_ROWS) -> GaussianParams:
        """In the passes after the scan, the discs with the steps that they missed; else those of
        the map."""
        if self._final is not None:
            return self._final.params_now(rows)
        return self.gaussians.params[rows]

    def take_missed_steps(self) -> None:
        """In the passes after the scan: bring all discs up to date."""
        if self._final is not None:
            self._final.take_missed_steps()
            self._final.write_back()

    def rows_changed(self, before: Int[Tensor, " N"]) -> None:
        """In the passes after the scan all rows stay stable, and Adam goes on with the rows that
        are left."""
        if self._final is not None:
            self.gaussians.state.fill_(STABLE)
            earlier = self._final
            self._final = self._final_optimiser()
            self._final.take_over(earlier, before)

    def _final_optimiser(self) -> SurfelOptimiser:
        config = self.config.final
        everything = torch.ones_like(self.gaussians.is_stable)
        return SurfelOptimiser(
            self.gaussians,
            everything,
            self.config.window,
            self.config.discs,
            lr_factor=config.lr_factor,
            move_centres=False,
            all_in_view=self.config.all_in_view,
            training=self.training,
            weight_depth=config.weight_depth,
        )

    def _draw(self, n: int) -> int:
        return int(torch.randint(n, (), generator=self.random.keyframes))

    def _undo_of_window(self) -> Undo:
        """Also the window and the optimiser of the final passes are undone."""
        window = list(self.window)
        final = self._final
        undo_adam = None if final is None else final.copies.log_changes()

        def undo() -> None:
            self.window = deque(window, maxlen=self.window.maxlen)
            self._final = final
            if final is not None and undo_adam is not None:
                undo_adam()
                final.copies.end_log()

        return undo

    def _end_log(self) -> None:
        if self._final is not None:
            self._final.copies.end_log()

    def _manage_states(self, frame: Frame) -> tuple[float, Transitions]:
        """Count errors of stable Gaussians, change states and remove outliers. Returns the PSNR of
        the view before."""
        part = self.parts.boxes.rows(self.gaussians.params, frame.camera, frame.T_WC)
        view = self.surface(frame.camera, frame.T_WC, frame.depth_m)
        if not runs_learners_code():
            self.transaction.keep()  # from here on the counts of any row change
        count_views(self.gaussians, frame.camera, frame.T_WC, part)
        known = frame.depth_m > 0
        colour_error = (view.rgb - frame.rgb).abs().mean(dim=-1) * known
        depth_error_m = torch.where(
            known & (view.depth_m > 0),
            frame.depth_m - view.depth_m,
            0.0,
        )
        count_errors(
            self.gaussians,
            colour_error,
            view.dominant_index,
            depth_error_m,
            view.hit_index,
            self.config.states,
        )
        per_step = self.config.window.confidence_per_step
        return _psnr_db(view.rgb, frame), change_states(
            self.gaussians, self.config.states, per_step
        )

    def surface(
        self,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        depth_m: Float[Tensor, "h w"] | None = None,
    ) -> SurfaceView:
        """Colour, transmittance, depth and normals of the map seen by a camera (Eq. 1-5).

        With ``depth_m``, the measured depth, a large map is not drawn far behind it, unless
        ``config.all_in_view``.
        """
        depth_m = None if self.config.all_in_view else depth_m
        T_WC = T_WC.to(self.device)
        return drawn_in_part(
            lambda params: view_surface(params, camera, T_WC, self.config.discs),
            self.gaussians.params,
            self.parts.boxes,
            camera,
            T_WC,
            depth_m,
            take=self.params_now,
        )

    def mesh(self) -> Mesh:
        """Surface of the map: depth rendered at poses along the trajectory, fused into a TSDF
        (``disc_mesh``)."""
        mesh, self.mesh_share = disc_mesh(self)
        return mesh

    @property
    def n_passes(self) -> int:
        """Number of passes of the final optimisation in the settings."""
        return self.config.final.passes

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """The state of any mapper, the window, and the optimiser of the final passes."""
        return super().state_dict(copies=copies) | {
            "camera": None if self.camera is None else vars(self.camera),
            "window": [frame.state_dict() for frame in self.window],
            "final": None if self._final is None else self._final.state_dict(),
        }

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.camera = None if state["camera"] is None else Camera(**state["camera"])
        self.window.extend(Frame.of_state(f).to(self.device) for f in state["window"])
        if state["final"] is not None:
            self._final = self._final_optimiser()
            self._final.load_state_dict(state["final"])

    def _record(self, frame: Frame) -> None:
        self.camera = frame.camera
        super()._record(frame)

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure the window moves as well."""
        super()._follow(correction)
        if correction is None:
            return
        moves = correction.transform_of(torch.tensor([f.index for f in self.window])).float()
        moved = [
            dataclasses.replace(f, T_WC=T.to(f.T_WC) @ f.T_WC)
            for f, T in zip(self.window, moves, strict=True)
        ]
        self.window = deque(moved, maxlen=self.window.maxlen)


def _psnr_db(rgb: Float[Tensor, "H W 3"], frame: Frame) -> float:
    return psnr_from_mse(float((rgb.clamp(0, 1) - frame.rgb).square().mean()))
