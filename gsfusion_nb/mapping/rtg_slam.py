"""RTG-SLAM (Peng et al. 2024): compact Gaussians, optimised while unstable, frame by frame in the
paper's order."""

import dataclasses
import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import RtgSlamConfig, rtg_slam, rtg_slam_fidelities, rtg_slam_fidelity
from ..gaussians import SurfelModel
from ..gaussians.surfel_states import state_counts
from ..geometry import se3
from ..large_maps import drawn_in_part
from ..render import SurfaceView, view_surface
from ..render.near_plane import near_plane_m
from ..seeding import DiscInputs, SeedContext, disc_view
from ..tracking import Correction
from ..types import Camera, Frame, Mesh, Seeds
from .description import CURVES, SystemDescription
from .disc_files import DiscFiles, disc_mesh
from .disc_optimisation import optimise_keyframes, optimise_window
from .disc_passes import DiscParts, DiscPasses
from .disc_states import STATES, DiscReports, manage_states, n_stable
from .lost_rows import remove_lost
from .mapper import Mapper
from .rule_calls import context_of
from .step_report import StepReport, psnr_db
from .transaction import Undo

KEYFRAME_DEG = 30.0
KEYFRAME_M = 0.3
"""A frame becomes a keyframe when the camera has turned, or its centre has moved, by this since the
last one."""


@dataclass(frozen=True)
class FramePlan:
    """What is done with a frame."""

    is_keyframe: bool
    window_is_due: bool
    """Whether the unstable Gaussians are optimised against the last frames."""
    keyframes_are_due: bool
    """Whether the keyframes are optimised over."""


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
    parts_type = DiscParts
    files_type = DiscFiles
    reports_type = DiscReports

    config: RtgSlamConfig
    gaussians: SurfelModel

    def __init__(self, *args: Any, **options: Any):
        self.disc_passes = DiscPasses(self)
        """The optimisation of all discs after the scan."""
        super().__init__(*args, **options)
        self.camera: Camera | None = None
        self.window: deque[Frame] = deque(maxlen=self.config.window.frames)
        self.transaction.protect(self._undo_of_window)
        self.localiser.followers.append(self._move_window)
        self.transaction.protect(self.disc_passes.snapshot, self.disc_passes.end_log)

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
            is_empty = not len(self.gaussians)
            psnr_before_db = math.nan if is_empty else psnr_db(disc_view(context).rgb, frame.rgb)
            seeds = self.propose_seeds(context)  # RTG-SLAM Eq. 6
        plan = self._plan(frame)
        with self.transaction.changes(undoable=plan.window_is_due or plan.keyframes_are_due):
            self._append(seeds, context, plan)
            with self.clock("optimise"):
                losses = optimise_window(self) if plan.window_is_due else []  # RTG-SLAM Eq. 7-9
            with self.clock("keyframes"):
                n_steps = optimise_keyframes(self) if plan.keyframes_are_due else 0
            self.guard.may_stop()
            remove_lost(self)
            with self.clock("states"):
                psnr_after_db, transitions = manage_states(self, frame)
            self.gaussians.clock.advance(self.n_frames + 1)
        self.camera = frame.camera
        return self.reports.of_frame(
            frame,
            seeds,
            plan.is_keyframe,
            losses=tuple(losses),
            n_steps=len(losses) + n_steps,
            psnr_before_db=psnr_before_db,
            psnr_after_db=psnr_after_db,
            counts=state_counts(self.gaussians) | vars(transitions),
        )

    def seed_context(self, frame: Frame, **inputs: Any) -> SeedContext:
        """What a seeding rule sees of this frame."""
        discs = DiscInputs(discs=self.config.discs)
        near_m = self.config.data.depth_min_m
        return context_of(self, frame, system=discs, near_m=near_m, **inputs)

    def is_next_keyframe(self, frame: Frame) -> bool:
        """Whether the camera has turned or moved far enough since the last keyframe."""
        if not len(self.keyframes):
            return True
        last = self.keyframes[len(self.keyframes) - 1].T_WC.to(frame.T_WC)
        angle_deg = torch.rad2deg(se3.rotation_angle(last[:3, :3].T @ frame.T_WC[:3, :3]))
        distance_m = (last[:3, 3] - frame.T_WC[:3, 3]).norm()
        return float(angle_deg) >= KEYFRAME_DEG or float(distance_m) >= KEYFRAME_M

    def _plan(self, frame: Frame) -> FramePlan:
        """Whether the frame is a keyframe, and what is optimised after it."""
        is_keyframe = self.is_next_keyframe(frame)
        is_first = not self.n_frames
        has_turn = (self.n_frames + 1) % self.config.window.every_frames == 0
        gives_way = (
            is_keyframe
            and self.config.keyframes.instead_of_window
            and bool(self.gaussians.is_stable.any())
        )
        return FramePlan(
            is_keyframe=is_keyframe,
            window_is_due=is_first or (has_turn and not gives_way),
            keyframes_are_due=is_keyframe and not is_first,
        )

    def _append(self, seeds: Seeds, context: SeedContext, plan: FramePlan) -> None:
        """Add the new Gaussians and the frame to the map; what will be optimised is told to
        ``after_steps``."""
        frame = context.frame
        self.parts.append(seeds, frame.index)
        self.disc_passes.forget()
        self.window.append(frame)
        if plan.is_keyframe:
            has_loss = self.training.loss is not None
            self.keyframes.append(frame, with_depth=True, with_extra=has_loss)
        n_steps = 0
        if plan.window_is_due:
            n_steps += self.config.window.iterations
        if plan.keyframes_are_due:
            n_steps += self.config.keyframes.iterations
        self.after_steps.frame_begins(context, n_steps)

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe, on all pixels and all Gaussians."""
        return self.disc_passes.step(self.keyframes[i].to(self.device))

    def _undo_of_window(self) -> Undo:
        window = list(self.window)

        def undo() -> None:
            self.window = deque(window, maxlen=self.window.maxlen)

        return undo

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
            lambda params: view_surface(
                params, camera, T_WC, self.config.discs, near_m=near_plane_m(self.config)
            ),
            self.gaussians.params,
            self.parts.boxes,
            camera,
            T_WC,
            depth_m,
            take=self.parts.params_now,
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
            "final": self.disc_passes.state_dict(),
        }

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.camera = None if state["camera"] is None else Camera(**state["camera"])
        self.window.extend(Frame.of_state(f).to(self.device) for f in state["window"])
        self.disc_passes.load_state_dict(state["final"])

    def _move_window(self, correction: Correction) -> None:
        """After a loop closure the window moves as well."""
        moves = correction.transform_of(torch.tensor([f.index for f in self.window])).float()
        frames = [
            dataclasses.replace(f, T_WC=T.to(f.T_WC) @ f.T_WC)
            for f, T in zip(self.window, moves, strict=True)
        ]
        self.window = deque(frames, maxlen=self.window.maxlen)
