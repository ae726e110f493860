"""What mappers with a TSDF have in common: the volume, its surface and mesh, and the frames that a
loop may move."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import BadFrameError
from ..geometry import backproject, se3
from ..seeding import SeedContext
from ..tracking import Correction
from ..tsdf import (
    NewBlocks,
    RaycastOutput,
    TsdfVolume,
    extract_mesh,
    integrate,
    new_band_blocks,
    raycast,
)
from ..types import Camera, Frame, Mesh, Seeds
from .mapper import Mapper
from .step import StepReport

MOVED_VOXELS = 0.5
"""The volume is made again when a frame's surface has moved by more than this many voxels."""

SEEN_WITHIN_M = 0.1
SEEN_WITHIN_DEG = 10.0
LATEST = 10
"""A frame shows nothing new if a keyframe was taken from a pose so near to its own, which is not
one of the latest."""


class FusedFrames:
    """Frames with the poses at which they were fused, in CPU memory, in the order of the
    trajectory.

    A frame that has moved is not taken out of the volume again: all frames are fused into a new
    one. That is exact also where the observation count has reached its limit, and after a loop most
    frames have moved. On the kitchen at 320x240 it takes 8.7 ms of processor time for each frame;
    taking out and putting in, 12 for each that moved.
    """

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def __len__(self) -> int:
        return len(self.frames)

    def images(self) -> list[Tensor]:
        """All images, which never change."""
        return [image for f in self.frames for image in (f.colour, f.depth_m)]

    def add(self, frame: Frame) -> None:
        """Keep a frame that is fused with its present pose."""
        bare = dataclasses.replace(frame, extra={})  # a new one, without colours as floats
        self.frames.append(bare.to("cpu"))

    def moved_m(self, poses: list[Float[Tensor, "4 4"]]) -> float:
        """How far a frame's camera, or a point at its median depth in a corner of its view, would
        move at most.

        The corners move also where a camera turns about its viewing axis, which leaves the middle
        of the view in place.

        Args:
            poses: New camera-to-world poses, one for each frame.

        Returns:
            The largest of these distances, metres.
        """
        if not self.frames:
            return 0.0
        change = (
            torch.stack(poses).cpu().double() - torch.stack([f.T_WC for f in self.frames]).double()
        )
        xyz_C = torch.stack([_camera_and_corners(f) for f in self.frames])
        return float((xyz_C @ change[:, :3, :3].mT + change[:, None, :3, 3]).norm(dim=-1).max())

    def fused_again(self, volume: TsdfVolume, poses: list[Float[Tensor, "4 4"]]) -> TsdfVolume:
        """A new volume like ``volume`` with all frames at new poses, which they keep.

        Raises:
            ValueError: a frame would be too far away for the voxel index. MemoryError: no room for
                the blocks. Nothing has changed.
        """
        fresh = TsdfVolume(
            volume.config, volume.device, memory_limit_bytes=volume.memory_limit_bytes
        )
        moved = [
            dataclasses.replace(f, T_WC=T)
            for f, T in zip(
                self.frames,
                torch.stack(poses).cpu(),
                strict=True,
            )
        ]
        for frame in moved:
            integrate(fresh, dataclasses.replace(frame.to(volume.device)))
        self.frames = moved
        return fresh

    def state_dict(self) -> list[dict[str, Any]]:
        """Plain values of every frame."""
        return [frame.state_dict() for frame in self.frames]

    def load_state(self, state: list[dict[str, Any]]) -> None:
        """Replace the frames by those of ``state_dict``."""
        self.frames = [Frame.of_state(f).to("cpu") for f in state]


def _camera_and_corners(frame: Frame) -> Float[Tensor, "5 3"]:
    """The camera's centre and the corners of its view at the median depth, in the camera's frame,
    float64."""
    some = frame.depth_m[::4, ::4]
    camera = frame.camera
    known = some[some > 0]
    z = known.median().double() if len(known) else torch.zeros((), dtype=torch.float64)
    corners = torch.tensor(
        [(u, v) for u in (0, camera.width) for v in (0, camera.height)],
        dtype=torch.float64,
    )
    return torch.cat(
        [torch.zeros(1, 3, dtype=torch.float64), backproject(camera, corners, z.expand(4))]
    )


class TsdfMapping(Mapper):
    """A mapper with a TSDF, ``volume``, by the settings ``config.tsdf``; arguments as for
    ``Mapper``."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.volume = TsdfVolume(self.config.tsdf, device=self.device)
        self.fused = FusedFrames()
        """The frames in ``volume``, if a loop may move them; empty without the back end."""

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.n_frames} frames, {len(self.gaussians):,} Gaussians, "
            f"{len(self.keyframes)} keyframes, {self.volume.n_blocks:,} voxel blocks, "
            f"rule {self.config.seeding.rule!r})"
        )

    def propose_seeds(self, context: SeedContext, **checks: Any) -> Seeds:
        """Ask the seeding rule for new Gaussians; there are none in a frame in which it is not
        due."""
        return super().propose_seeds(
            context, one_per_voxel=self.config.seeding.one_per_voxel, **checks
        )

    def surface(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """Depth, normals and colours of the TSDF map's surface seen by a camera."""
        return raycast(self.volume, camera, T_WC.to(self.device))

    def mesh(self) -> Mesh:
        """Surface of the TSDF map."""
        return extract_mesh(self.volume)

    def counts(self) -> dict[str, int]:
        """Number of voxel blocks of the TSDF."""
        return {"n_blocks": self.volume.n_blocks}

    def maps(self) -> dict[str, dict[str, Tensor]]:
        """Gaussians and the TSDF."""
        volume = self.volume
        columns = {
            "block_coords": volume.block_coords,
            "D": volume.D,
            "W": volume.W,
            "rgb": volume.rgb_planes,
        }
        return super().maps() | {"tsdf": columns}

    def order_of_rows(self, name: str) -> Tensor | None:
        """The blocks of the TSDF in Morton order."""
        return self.volume.index.rows if name == "tsdf" else None

    def step_warnings(self, frame: Frame, report: StepReport) -> list[str]:
        """In addition: a warning if no depth of the first frame is in the range that is fused."""
        warnings = super().step_warnings(frame, report)
        if self.n_frames > 1 or report.n_blocks:
            return warnings
        tsdf = self.config.tsdf
        known = frame.depth_m[frame.depth_m > 0]
        median = (
            f"its median is {float(known.median()):.4g} m" if len(known) else "it has none at all"
        )
        if ((known >= tsdf.near_m) & (known <= tsdf.far_m)).any():
            return [
                *warnings,
                f"nothing was mapped from the depth of frame {frame.index} ({median})",
            ]
        return [
            *warnings,
            f"frame {frame.index} has no depth between tsdf.near_m {tsdf.near_m:g} and tsdf.far_m "
            f"{tsdf.far_m:g} m ({median}), so nothing was mapped from it; check the depth scale",
        ]

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

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the frames in the TSDF."""
        return [*super().constant_tensors(), *self.fused.images()]

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

    def _undo(self) -> Callable[[], None]:
        """Of the first frame also the TSDF, which is fused last."""
        undo_rows = super()._undo()
        was_empty = not self.n_frames

        def undo() -> None:
            undo_rows()
            if was_empty:
                volume = self.volume
                limit = volume.memory_limit_bytes
                self.volume = TsdfVolume(volume.config, volume.device, memory_limit_bytes=limit)

        return undo

    def _report(self, *args: Any, **fields: Any) -> StepReport:
        return super()._report(*args, n_blocks=self.volume.n_blocks, **fields)

    def _record(self, frame: Frame) -> None:
        """Keep the frame, which was fused, if a loop may move it."""
        tracking = self.config.tracking
        if tracking.poses == "tracked" and tracking.back_end:
            self.fused.add(frame)
        super()._record(frame)

    def _follow(self, correction: Correction | None) -> None:
        """After a loop closure that moved a frame by more than half a voxel, the TSDF is made
        again."""
        super()._follow(correction)
        if correction is None or not len(self.fused):
            return
        poses = self.localiser.poses
        if self.fused.moved_m(poses) <= MOVED_VOXELS * self.volume.config.voxel_size_m:
            return
        try:
            self.volume = self.fused.fused_again(self.volume, poses)
        except (MemoryError, ValueError) as e:
            self.notes.append(
                "the TSDF stays as it was before the loop at frame "
                f"{int(correction.frame_index[-1])}: {e}"
            )

    def _make_room(self, frame: Frame) -> NewBlocks:
        """Make room for the blocks that the frame needs. Returns those that do not exist yet."""
        try:
            return self.volume.reserve(new_band_blocks(self.volume, frame))
        except ValueError as e:
            raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
