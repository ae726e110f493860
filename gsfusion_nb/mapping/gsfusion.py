"""GSFusion (Wei & Leutenegger 2024): TSDF fusion and Gaussian splatting, one frame at a time, in the paper's order."""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import GSFusionConfig, from_dict, to_dict
from ..errors import BadFrameError
from ..gaussians import GaussianModel
from ..optim import Keyframe, KeyframeList, adam_step, dssim_vjp, l1_mse_vjp
from ..render import render, render_forward, render_vjp
from ..seeding import SeedContext, SeedingRule, apply_rule, get_rule
from ..tracking import Correction, tsdf_surface
from ..tsdf import RaycastOutput, TsdfVolume, extract_mesh, integrate, raycast
from ..types import Camera, Frame, Mesh, RenderOutput, Seeds
from .frame_checks import check_frame
from .keyframe_passes import KeyframePasses
from .localiser import Localiser, move_map
from .step_report import GlobalStep, StageClock, StepReport, psnr_from_mse


class GSFusion:
    """The mapper: feed it frames with ``step``; its two maps are ``volume`` and ``gaussians``.

    Args:
        config: Settings; see ``gsfusion_nb.config.gsfusion`` for the published presets.
        seeding: Name of a registered rule, or the rule function itself; overrides ``config.seeding.rule``.
        device: Where the maps live.

    GSFusion as published takes the poses as given; ``config.tracking.poses = "tracked"`` aligns each frame to the TSDF
    by RTG-SLAM's ICP instead.
    """

    def __init__(
        self,
        config: GSFusionConfig | None = None,
        *,
        seeding: "str | SeedingRule | None" = None,
        device: torch.device | str = "cpu",
    ):
        self.config = config or GSFusionConfig()
        self.rule = get_rule(seeding if seeding is not None else self.config.seeding.rule)
        self.device = torch.device(device)
        self.volume = TsdfVolume(self.config.tsdf, device=self.device)
        self.gaussians = GaussianModel(self.config.sh_degree, device=self.device)
        self.keyframes = KeyframeList("cpu" if self.config.keyframes_on == "cpu" else self.device)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.n_frames = 0
        self.passes = KeyframePasses()
        self.localiser = Localiser(self.config.tracking)

    def __repr__(self) -> str:
        return (
            f"GSFusion({self.n_frames} frames, {len(self.gaussians):,} Gaussians, {len(self.keyframes)} keyframes, "
            f"{self.volume.n_blocks:,} voxel blocks, rule {self.rule.__name__!r})"
        )

    def step(self, frame: Frame) -> StepReport:
        """Map one frame (paper Fig. 2, section III-B).

        Raises:
            BadFrameError: the pose is not rigid, an image holds a NaN or colours beyond 0..1, or the frame lies too far
                away for the voxel index. The maps are unchanged.
        """
        frame = check_frame(frame, self.device)
        clock = StageClock()
        with clock("tracking"):
            frame = self.localiser.locate(frame, tsdf_surface(self.volume))
        with clock("tsdf"):
            self._fuse(frame)  # III-B.1, Eq. 6-9
        with clock("seeding"):
            context = self.seed_context(frame)
            seeds = self.propose_seeds(context)  # III-B.2, Eq. 10
            self.gaussians.append(seeds, frame.index)
        clock.split("seeding", "quadtree", context.quadtree_seconds)
        is_keyframe = len(seeds) > self.config.keyframe_min_seeds  # III-B.3
        if is_keyframe or self.config.keep_all_frames:
            self.keyframes.append(frame)
        with clock("optimise"):
            losses, psnrs = self._optimise_online(frame, is_keyframe)  # Eq. 12
        with clock("tracking"):
            self._correct(self.localiser.record(frame))
        self.n_frames += 1
        return StepReport(
            frame_index=frame.index,
            n_seeds=len(seeds),
            n_gaussians=len(self.gaussians),
            n_blocks=self.volume.n_blocks,
            is_keyframe=is_keyframe,
            losses=tuple(losses),
            psnr_before_db=psnrs[0] if psnrs else 0.0,
            psnr_after_db=psnrs[-1] if psnrs else 0.0,
            tracking=self.localiser.report,
            seconds=clock.seconds,
        )

    def seed_context(self, frame: Frame) -> SeedContext:
        """What a seeding rule sees of this frame, after it was fused into the TSDF."""
        return SeedContext(
            frame,
            volume=self.volume,
            gaussians=self.gaussians,
            generator=self.generator,
            config=self.config.seeding,
            near_m=self.config.tsdf.near_m,
        )

    def propose_seeds(self, context: SeedContext) -> Seeds:
        """Ask the seeding rule for new Gaussians."""
        options = self.config.seeding.options
        return apply_rule(self.rule, context, options, one_per_voxel=self.config.seeding.one_per_voxel)

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """The Gaussian map seen by a camera (Eq. 11)."""
        return render(self.gaussians.params, camera, T_WC.to(self.device))

    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """Depth, normals and colours of the TSDF map's surface seen by a camera."""
        return raycast(self.volume, camera, T_WC.to(self.device))

    def mesh(self) -> Mesh:
        """Surface of the TSDF map."""
        return extract_mesh(self.volume)

    def global_optimise(self, passes: int | None = None) -> Iterator[GlobalStep]:
        """Optimise over the keyframes after the scan: each pass visits all of them once in a new random order.

        A generator, so that the caller can show progress or stop: ``for step in mapper.global_optimise(): ...``.

        Args:
            passes: Number of passes; ``config.optim.global_iterations`` by default. One that was cut short is finished
                first and counts as one of them.
        """
        passes = self.n_passes if passes is None else passes
        if not self.passes.begun:
            self._correct(self.localiser.finish())
        yield from self.passes.run(passes, len(self.keyframes), self.generator, self._optimise_globally)

    @property
    def n_passes(self) -> int:
        """Passes of the global optimisation that the settings ask for."""
        return self.config.optim.global_iterations

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on later exactly where this stands, as tensors and plain values."""
        return {
            "config": to_dict(self.config),
            "rule": self.rule.__name__,
            "n_frames": self.n_frames,
            "passes": self.passes.state_dict(),
            "localiser": self.localiser.state_dict(),
            "generator": self.generator.get_state(),
            "volume": self.volume.state_dict(),
            "gaussians": self.gaussians.state_dict(),
            "keyframes": self.keyframes.state_dict(),
        }

    @classmethod
    def from_state_dict(
        cls,
        state: dict[str, Any],
        *,
        seeding: "str | SeedingRule | None" = None,
        device: torch.device | str = "cpu",
    ) -> "GSFusion":
        """The mapper that ``state_dict`` described; a rule that is not registered by name must be given again."""
        config = from_dict(GSFusionConfig, state["config"])
        mapper = cls(config, seeding=seeding if seeding is not None else state["rule"], device=device)
        mapper.n_frames = state["n_frames"]
        mapper.passes.load_state_dict(state["passes"])
        mapper.localiser.load_state_dict(state["localiser"])
        mapper.generator.set_state(state["generator"])
        mapper.volume.load_state_dict(state["volume"])
        mapper.gaussians = GaussianModel.from_state_dict(state["gaussians"], device)
        mapper.keyframes = KeyframeList.from_state_dict(state["keyframes"], mapper.keyframes.device)
        return mapper

    def _fuse(self, frame: Frame) -> None:
        """Fold the frame into the TSDF."""
        try:
            integrate(self.volume, frame)
        except ValueError as e:
            raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None

    def _correct(self, correction: Correction | None) -> None:
        """After a closed loop: Gaussians and keyframes move with the trajectory if asked to; the TSDF stays."""
        if correction is not None and self.config.tracking.back_end.on_correction == "move":
            move_map(correction, self.gaussians, self.keyframes)

    def _optimise_online(self, frame: Frame, is_keyframe: bool) -> tuple[list[float], list[float]]:
        """m steps on a keyframe; n on another frame, then some on random keyframes against forgetting (III-B.3)."""
        optim = self.config.optim
        if len(self.gaussians) == 0:
            return [], []
        n = optim.keyframe_iterations if is_keyframe else optim.frame_iterations
        steps = [self._optimise_view(frame) for _ in range(n)]
        if not is_keyframe:
            for keyframe in self.keyframes.draw(optim.random_keyframe_iterations, self.generator):
                self._optimise_view(keyframe)
        if not steps:
            return [], []
        losses, errors = torch.stack([torch.stack(step) for step in steps], dim=1).tolist()
        return losses, [psnr_from_mse(mse) for mse in errors]

    def _optimise_globally(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe after the scan."""
        return self._optimise_view(self.keyframes[i], ssim_weight=self.config.optim.ssim_weight)[0]

    def _optimise_view(
        self, view: Frame | Keyframe, ssim_weight: float = 0.0
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """One gradient step on one view; its loss and squared error before it. Online the loss is L1 alone (Eq. 12).

        Both stay on the device: waiting for them after every step would leave a GPU idle.
        """
        view = view.to(self.device)
        target = view.rgb
        output, saved = render_forward(self.gaussians.params, view.camera, view.T_WC, with_indices=False)
        pixels = l1_mse_vjp(output.rgb, target)
        loss, v_rgb = pixels.value, pixels.v_rgb
        if ssim_weight > 0:
            structural, v_structural = dssim_vjp(output.rgb, target)
            loss = (1 - ssim_weight) * loss + ssim_weight * structural
            v_rgb = (1 - ssim_weight) * v_rgb + ssim_weight * v_structural
        adam_step(self.gaussians, render_vjp(saved, v_rgb), self.config.optim)
        return loss, pixels.mse
