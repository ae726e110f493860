"""What mappers with a TSDF have in common: the volume, its surface and mesh, its files and
reports."""

from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..errors import BadFrameError
from ..export.tsdf_file import TSDF, read_tsdf, write_tsdf
from ..geometry import se3
from ..seeding import SeedContext
from ..tracking import Correction, SurfaceSource
from ..tsdf import (
    NewBlocks,
    RaycastOutput,
    TsdfVolume,
    extract_mesh,
    new_band_blocks,
    raycast,
)
from ..types import Camera, Frame, GaussianParams, Mesh, Seeds
from .fused_frames import FusedFrames
from .map_files import MapFiles
from .map_reports import MapReports
from .mapper import Mapper
from .rule_calls import ask_rule
from .step_report import StepReport
from .tracking_surface import surface_seen
from .transaction import Undo

MOVED_VOXELS = 0.5
"""The volume is made again when a frame's surface has moved by more than this many voxels."""

SEEN_WITHIN_M = 0.1
SEEN_WITHIN_DEG = 10.0
LATEST = 10
"""A frame shows nothing new if a keyframe was taken from a pose so near to its own, which is not
one of the latest."""


class TsdfFiles(MapFiles):
    """Gaussians and a TSDF."""

    def maps(self) -> dict[str, dict[str, Tensor]]:
        """Gaussians and the TSDF."""
        volume = self.mapper.volume
        columns = {
            "block_coords": volume.block_coords,
            "D": volume.D,
            "W": volume.W,
            "rgb": volume.rgb_planes,
        }
        return super().maps() | {"tsdf": columns}

    def order_of_rows(self, name: str) -> Tensor | None:
        """The blocks of the TSDF in Morton order."""
        return self.mapper.volume.index.rows if name == "tsdf" else None

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the frames in the TSDF."""
        return [*super().constant_tensors(), *self.mapper.fused.images()]

    def write_besides(self, folder: Path) -> None:
        """Write the TSDF."""
        write_tsdf(folder / TSDF, self.mapper.volume)

    def stored_volume(self, folder: Path) -> dict[str, Any]:
        """State of the volume in the folder of a run with the mapper's settings."""
        return read_tsdf(folder / TSDF, self.mapper.config.tsdf).state_dict(copies=False)

    @classmethod
    def surface_from(cls, folder: Path, params: GaussianParams, config: Any) -> SurfaceSource:
        """The surface of the TSDF."""
        volume = read_tsdf(folder / TSDF, config.tsdf, params.xyz_W.device)
        return lambda camera, T_WC: surface_seen(
            raycast(volume, camera, T_WC.to(volume.device)), camera, T_WC
        )


class TsdfReports(MapReports):
    """Reports that count voxel blocks."""

    def of_frame(self, *args: Any, **fields: Any) -> StepReport:
        """Also with the number of voxel blocks."""
        return super().of_frame(*args, n_blocks=self.mapper.volume.n_blocks, **fields)

    def counts(self) -> dict[str, int]:
        """Number of voxel blocks of the TSDF."""
        return {"n_blocks": self.mapper.volume.n_blocks}

    def step_warnings(self, frame: Frame, report: StepReport) -> list[str]:
        """In addition: a warning if no depth of the first frame is in the range that is fused."""
        warnings = super().step_warnings(frame, report)
        if self.mapper.n_frames > 1 or report.n_blocks:
            return warnings
        tsdf = self.mapper.config.tsdf
        measured_m = frame.depth_m[frame.depth_m > 0]
        median = "it has none at all"
        if len(measured_m):
            median = f"its median is {float(measured_m.median()):.4g} m"
        if ((measured_m >= tsdf.near_m) & (measured_m <= tsdf.far_m)).any():
            sentence = f"nothing was mapped from the depth of frame {frame.index} ({median})"
        else:
            sentence = (
                f"frame {frame.index} has no depth between tsdf.near_m {tsdf.near_m:g} and "
                f"tsdf.far_m {tsdf.far_m:g} m ({median}), so nothing was mapped from it; check the "
                "depth scale"
            )
        return [*warnings, sentence]


class TsdfMapping(Mapper):
    """A mapper with a TSDF, ``volume``, by the settings ``config.tsdf``; arguments as for
    ``Mapper``."""

    files_type = TsdfFiles
    reports_type = TsdfReports

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.volume = TsdfVolume(self.config.tsdf, device=self.device)
        self.fused = FusedFrames()
        """The frames in ``volume``, if a loop may move them; empty without the back end."""
        self.transaction.protect(self._undo_of_first_frame)
        self.localiser.followers.append(self._fuse_again)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.n_frames} frames, {len(self.gaussians):,} Gaussians, "
            f"{len(self.keyframes)} keyframes, {self.volume.n_blocks:,} voxel blocks, "
            f"rule {self.config.seeding.rule!r})"
        )

    def propose_seeds(self, context: SeedContext, **checks: Any) -> Seeds:
        """Ask the seeding rule for new Gaussians; there are none in a frame in which it is not
        due."""
        return ask_rule(self, context, one_per_voxel=self.config.seeding.one_per_voxel, **checks)

    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """Depth, normals and colours of the TSDF map's surface seen by a camera."""
        return raycast(self.volume, camera, T_WC.to(self.device))

    def mesh(self) -> Mesh:
        """Surface of the TSDF map."""
        return extract_mesh(self.volume)

    def _seen_before(self, frame: Frame) -> bool:
        """Whether an earlier keyframe shows what the frame shows."""
        earlier = self.keyframes.T_WC[:-LATEST]
        T_WC = frame.T_WC.cpu()
        near = earlier[(earlier[:, :3, 3] - T_WC[:3, 3]).norm(dim=1) <= SEEN_WITHIN_M]
        return bool(
            (
                se3.rotation_angle(near[:, :3, :3].mT @ T_WC[:3, :3]).rad2deg() <= SEEN_WITHIN_DEG
            ).any()
        )

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """The state of any mapper, and the TSDF with the frames that a loop may move."""
        volume = self.volume.state_dict(copies=copies)
        return super().state_dict(copies=copies) | {
            "volume": volume,
            "fused": self.fused.state_dict(),
        }

    def _load(self, state: dict[str, Any]) -> None:
        super()._load(state)
        self.volume.load_state_dict(state["volume"])
        self.fused.load_state(state["fused"])

    def _undo_of_first_frame(self) -> Undo:
        """Of the first frame also the TSDF is undone, which is fused last."""
        is_empty = not self.n_frames

        def undo() -> None:
            if is_empty:
                volume = self.volume
                limit = volume.memory_limit_bytes
                self.volume = TsdfVolume(volume.config, volume.device, memory_limit_bytes=limit)

        return undo

    def _record(self, frame: Frame) -> None:
        """Keep the frame, which was fused, if a loop may move it."""
        tracking = self.config.tracking
        if tracking.poses == "tracked" and tracking.back_end:
            self.fused.add(frame)
        super()._record(frame)

    def _fuse_again(self, correction: Correction) -> None:
        """After a loop closure that moved a frame by more than half a voxel, the TSDF is made
        again."""
        if not len(self.fused):
            return
        poses = self.trajectory.poses
        if self.fused.moved_m(poses) <= MOVED_VOXELS * self.volume.config.voxel_size_m:
            return
        try:
            self.volume = self.fused.fused_again(self.volume, poses)
        except (MemoryError, ValueError) as e:
            self.notes.append(
                "the TSDF stays as it was before the loop at frame "
                f"{int(correction.frame_index[-1])}: {e}"
            )

    def make_room(self, frame: Frame) -> NewBlocks:
        """Make room for the blocks that the frame needs. Returns those that do not exist yet."""
        try:
            return self.volume.reserve(new_band_blocks(self.volume, frame))
        except ValueError as e:
            raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
