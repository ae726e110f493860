"""RTG-SLAM (Peng et al. 2024): compact Gaussians, optimised while unstable, frame by frame in the paper's order."""

import dataclasses
import math
from collections import deque
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import runs_learners_code
from ..checks import check_number, check_whole
from ..config import RtgSlamConfig, rtg_slam, rtg_slam_fidelity
from ..gaussians import SurfelModel, Transitions, change_states, count_errors, count_views, state_counts
from ..geometry import se3
from ..render import SurfaceView, render_forward, surface_depth_m, view_surface
from ..seeding import SeedContext
from ..tracking import Correction, Surface
from ..types import Camera, Frame, GaussianParams, Mesh, RenderOutput
from .frame_checks import check_frame
from .mapper import Mapper
from .rendered_mesh import mesh_of_views
from .step_report import StageClock, StepReport, psnr_from_mse
from .surfel_mapping import SurfelMapping


class RTGSLAM(SurfelMapping):
    """RTG-SLAM: its map is ``gaussians``, discs on the surface.

    Settings and published presets: ``gsfusion_nb.config.rtg_slam``.
    """

    title = "RTG-SLAM"
    config_type = RtgSlamConfig
    preset = staticmethod(rtg_slam)
    fidelities = ("measured", "paper", "code")
    fidelity_of = staticmethod(rtg_slam_fidelity)
    model_type = SurfelModel
    gaussians_are_discs = True
    panels = ("input", "render", "error", "depth_error", "states", "seed_causes")
    curves: ClassVar = Mapper.curves | {
        "stable Gaussians": lambda report: report.counts["stable_opaque"] + report.counts["stable_transparent"]
    }
    memory_savers = ("a smaller share in seeding.options",)

    config: RtgSlamConfig
    gaussians: SurfelModel

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.camera: Camera | None = None

    def __repr__(self) -> str:
        counts = ", ".join(f"{n:,} {name.replace('_', ' ')}" for name, n in state_counts(self.gaussians).items())
        note = self.rule_in_use.memory_note
        return f"RTGSLAM({self.n_frames} frames, {len(self.gaussians):,} Gaussians ({counts}){note})"

    def step(self, frame: Frame) -> StepReport:
        """Map one frame (paper Fig. 2, section 3.2), all of it or nothing.

        Raises:
            BadFrameError: the frame cannot be used. The map is unchanged.
            RuntimeError: another thread is in a step, or an earlier frame was only half mapped.
        """
        with self.one_frame(frame):
            frame, clock = check_frame(frame, self.device, needs_depth=True), StageClock()
            with clock("tracking"):
                frame = self.localiser.locate(frame, self._tracking_surface)  # Eq. 10
            with clock("seeding"):
                context = self.seed_context(frame)
                before = _psnr(context.surface().rgb, frame) if len(self.gaussians) else math.nan
                seeds = self.propose_seeds(context)  # Eq. 6
            is_keyframe = self.is_next_keyframe(frame)
            window_is_due, keyframes_are_due = self._window_is_due(is_keyframe), is_keyframe and self.n_frames > 0
            is_lesson = runs_learners_code() or bool(self.training.names)
            self.guard.changes_begin(self._undo() if window_is_due or keyframes_are_due or is_lesson else None)
            self.gaussians.append(seeds, frame.index)
            self._begin(context, is_keyframe, window_is_due, keyframes_are_due)
            with clock("optimise"):
                losses = self._optimise_window() if window_is_due else []  # Eq. 7-9
            with clock("keyframes"):
                n_steps = self._optimise_keyframes() if keyframes_are_due else 0
            self.guard.may_stop()
            if not is_lesson:
                self.guard.changes_stay()
            with clock("states"):
                after, transitions = self._manage_states(frame)
            self.guard.changes_stay()
            with clock("tracking"):
                self._record(frame)
            self.camera = frame.camera
            self.n_frames += 1
            self.gaussians.step_count = self.n_frames
        return StepReport(
            frame_index=frame.index,
            n_seeds=len(seeds),
            n_gaussians=len(self.gaussians),
            n_steps=len(losses) + n_steps,
            is_keyframe=is_keyframe,
            losses=tuple(losses),
            psnr_before_db=before,
            psnr_after_db=after,
            tracking=self.localiser.report,
            counts=state_counts(self.gaussians) | vars(transitions),
            seconds=clock.seconds,
        )

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame."""
        return self._context(frame, discs=self.config.discs, near_m=self.config.data.depth_min_m)

    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfaceView:
        """Colour, transmittance, depth and normals of the map seen by a camera (Eq. 1-5)."""
        return view_surface(self.gaussians.params, camera, T_WC.to(self.device), self.config.discs)

    @classmethod
    def render_gaussians(
        cls, params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"], config: RtgSlamConfig
    ) -> RenderOutput:
        """The map seen by a camera, with the depth of its discs as ``surface_depth_m``."""
        output, _ = render_forward(params, camera, T_WC, opaque_alpha=config.discs.opaque_alpha)
        depth_m = surface_depth_m(params, camera, T_WC, output, config.discs)
        return dataclasses.replace(output, surface_depth_m=depth_m)

    def mesh(self) -> Mesh:
        """Surface of the map: depth rendered from poses along the whole trajectory, fused into a TSDF."""
        return mesh_of_views(self.surface, self.camera, self.localiser.poses, self.config.mesh, self.device)

    @property
    def n_passes(self) -> int:
        """Number of passes of the final optimisation in the settings."""
        return self.config.final.passes

    def counts(self) -> dict[str, int]:
        """Gaussians by state and kind."""
        return {f"n_{name}": count for name, count in state_counts(self.gaussians).items()}

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the window."""
        return [*super().constant_tensors(), *(image for f in self.window for image in (f.colour, f.depth_m))]

    def state_dict(self) -> dict[str, Any]:
        """The state of any mapper, the window, and the optimiser of the final passes."""
        return super().state_dict() | {
            "camera": None if self.camera is None else vars(self.camera),
            "window": [frame.state_dict() for frame in self.window],
            "final": None if self._final is None else self._final.state_dict(),
        }

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.camera = None if state["camera"] is None else Camera(**state["camera"])
        for f in state["window"]:
            check_whole("index of a frame", f["index"], 0)
            check_number(f"time of frame {f['index']}", f["timestamp_s"])
            self.window.append(check_frame(Frame.of_state(f), self.device, needs_depth=True))
        if state["final"] is not None:
            self._final = self._final_optimiser()
            self._final.load_state_dict(state["final"])

    def _tracking_surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Surface:
        view = self.surface(camera, T_WC)
        return Surface(depth_m=view.depth_m, normal_W=view.normal_W, camera=camera, T_WC=T_WC, rgb=view.rgb)

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure the window moves as well."""
        super()._follow(correction)
        if correction is None or self.config.tracking.back_end.on_correction == "leave":
            return
        moves = correction.transform_of(torch.tensor([f.index for f in self.window])).float()
        moved = [dataclasses.replace(f, T_WC=T.to(f.T_WC) @ f.T_WC) for f, T in zip(self.window, moves, strict=True)]
        self.window = deque(moved, maxlen=self.window.maxlen)

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe."""
        if not len(self.keyframes):
            return True
        limits, last = self.config.keyframes, self.keyframes[len(self.keyframes) - 1].T_WC.to(frame.T_WC)
        turned = torch.rad2deg(se3.rotation_angle(last[:3, :3].T @ frame.T_WC[:3, :3]))
        moved = (last[:3, 3] - frame.T_WC[:3, 3]).norm()
        return float(turned) >= limits.rotation_deg or float(moved) >= limits.translation_m

    def _manage_states(self, frame: Frame) -> tuple[float, Transitions]:
        """Count errors of stable Gaussians, change states and remove outliers. Returns the PSNR of the view before."""
        count_views(self.gaussians, frame.camera, frame.T_WC)
        view = self.surface(frame.camera, frame.T_WC)
        known = frame.depth_m > 0
        colour_error = (view.rgb - frame.rgb).abs().mean(dim=-1) * known
        depth_error_m = torch.where(known & (view.depth_m > 0), frame.depth_m - view.depth_m, 0.0)
        count_errors(
            self.gaussians, colour_error, view.dominant_index, depth_error_m, view.hit_index, self.config.states
        )
        return _psnr(view.rgb, frame), change_states(self.gaussians, self.config.states)


def _psnr(rgb: Float[Tensor, "H W 3"], frame: Frame) -> float:
    return psnr_from_mse(float((rgb.clamp(0, 1) - frame.rgb).square().mean()))
