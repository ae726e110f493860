"""The pose of each frame, given by the data or tracked against the map; the trajectory and its
corrections."""

import bisect
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import tracking
from ..config import TrackingConfig
from ..errors import BadFrameError
from ..gaussians import GaussianModel
from ..gaussians.rigid_motion import move_map_
from ..geometry import se3
from ..optim import KeyframeList
from ..types import Camera, Frame
from .keyframe_memory import KeyframeMemory
from .pose_jumps import PoseJumps

_BLOCK = 1024
"""Number of poses that are stored in one tensor."""


class Localiser:
    """The trajectory of a run, one pose per mapped frame.

    With ``config.poses == "given"`` a frame keeps its pose. With "tracked" only the first does; the
    others are aligned to the map (Peng et al. 2024, Eq. 10), and the back end, where enabled,
    corrects the trajectory when a loop closes.
    """

    def __init__(self, config: TrackingConfig):
        self.config = config
        self.poses: list[Float[Tensor, "4 4"]] = []
        """Camera-to-world pose of every mapped frame, on the CPU; corrected when a loop closes."""
        self.given_poses: list[Float[Tensor, "4 4"]] = []
        """The same poses before pictures refined them; the same tensors where none did."""
        self.frame_indices: list[int] = []
        self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_in_blocks = 0
        self.report: dict[str, Any] = {}
        """How the last frame was tracked: status, rms_m, inlier_share. Empty for given poses."""
        self.jump = ""
        """How far the given pose of the last frame is from those before, if no camera moves so
        fast; else empty."""
        self._jumps = PoseJumps(config.pose_jumps)
        self._tracker = tracking.Tracker(config)
        self._earlier_state: Any = None
        """State of the tracker before the frame that it was given last, until that frame is
        recorded or refused."""
        self.memory = KeyframeMemory(config)
        """The keyframes by appearance."""

    @property
    def is_tracking(self) -> bool:
        """Whether poses are estimated."""
        return self.config.poses == "tracked"

    @property
    def frames_lost(self) -> int:
        """Number of frames in a row that could not be tracked, up to the last one; 0 if that one
        was."""
        return self._tracker.lost_in_a_row

    @property
    def is_refined(self) -> bool:
        """Whether pictures have moved a pose away from the given one (``optim.refine_poses``)."""
        pairs = zip(self.poses, self.given_poses, strict=False)
        return any(T_WC is not T_given for T_WC, T_given in pairs)

    def refine(self, row: int, T_WC: Float[Tensor, "4 4"]) -> None:
        """Give the mapped frame with this number another pose; ``given_poses`` keeps the one
        before."""
        if self.poses[row] is self.given_poses[row]:
            self.poses[row] = self._in_block(self.given_poses[row])
        self.poses[row].copy_(T_WC)

    def undo_of_refinement(self) -> Callable[[], None]:
        """A function that undoes what ``refine`` and ``follow`` change from now on."""
        poses = list(self.poses)
        values = [pose.clone() for pose in poses]

        def undo() -> None:
            self.poses = list(poses)
            for pose, value in zip(self.poses, values, strict=True):
                pose.copy_(value)

        return undo

    def follow(self, rows: list[int]) -> None:
        """Refine the frames between those with the numbers ``rows``, which were refined: each by
        what they were."""
        indices = torch.tensor([self.frame_indices[row] for row in rows])
        twists = self._twists(rows)
        for row in set(range(len(self.poses))) - set(rows):
            xi = between(indices, twists, self.frame_indices[row])
            self.refine(
                row,
                (self.given_poses[row].double() @ se3.exp(xi)).float(),
            )

    def refined_pose(
        self,
        index: int,
        T_WC: Float[Tensor, "4 4"],
    ) -> Float[Tensor, "4 4"]:
        """The given pose of any frame of the source, moved as the mapped frames before and after it
        were refined."""
        if not self.is_refined:
            return T_WC
        twists = self._twists(range(len(self.poses)))
        xi = between(torch.tensor(self.frame_indices), twists, index)
        return (T_WC.double() @ se3.exp(xi)).to(T_WC)

    def places(self) -> tracking.Places | None:
        """What finds a camera again in this map: keyframes with their poses as they are by now;
        None if there are none."""
        moved = () if self.is_tracking else zip(self.frame_indices, self.poses, strict=True)
        return self.memory.places(dict(moved))

    def pose_near(self, index: int) -> Float[Tensor, "4 4"]:
        """A pose between those of the mapped frames before and after any frame of the source, or
        the first or last."""
        poses = torch.stack(self.poses).double()
        row = bisect.bisect(self.frame_indices, index)
        if row in (0, len(poses)):
            return poses[min(row, len(poses) - 1)]
        first, last = self.frame_indices[row - 1 : row + 1]
        step = se3.log(se3.inverse(poses[row - 1]) @ poses[row])
        return poses[row - 1] @ se3.exp((index - first) / (last - first) * step)

    def _twists(self, rows: Iterable[int]) -> Float[Tensor, "R 6"]:
        """How far some frames were refined, each in its camera's frame."""
        rows = list(rows)
        T_given = torch.stack([self.given_poses[row] for row in rows]).double()
        T_refined = torch.stack([self.poses[row] for row in rows]).double()
        return se3.log(se3.inverse(T_given) @ T_refined)

    def locate(self, frame: Frame, surface: tracking.SurfaceSource) -> Frame:
        """The frame with its pose in the map: the given one, or by ICP to the surface.

        Raises:
            BadFrameError: tracking is lost and could not recover with this frame; or the given pose
                is a jump that no camera makes, both from the last mapped frame and from a frame
                just refused.
        """

        def align() -> tracking.TrackingReport:
            if self.is_before_first_look:
                self.memory.see_through(frame.camera)
                return self._tracker.find(frame, surface, self.memory.relocalise)
            sighting, guess = self.memory.sight(frame, self._tracker)
            extra = None if sighting is None else sighting.extra
            return self._tracker.track(frame, surface, self.memory.relocalise, extra, guess)

        return self._locate(frame, align)

    def locate_by(self, find: tracking.PoseFinder, frame: Frame) -> Frame:
        """The frame with its pose in the map: the given one, or as a system's own tracking finds
        it, from the predicted pose (``Tracker.track_by``).

        Raises:
            BadFrameError: as for ``locate``. Exception: what ``find`` raises.
        """
        return self._locate(frame, lambda: self._tracker.track_by(find, frame))

    def _locate(self, frame: Frame, track: Callable[[], tracking.TrackingReport]) -> Frame:
        self.report = {}
        self.jump = ""
        self._earlier_state = None
        if not self.is_tracking:
            self.jump = self._jumps.check(frame)
            return frame
        self._earlier_state = self._tracker.standing
        try:
            pose = track()
        except tracking.TrackingLostError as e:
            raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
        fit = pose.icp
        self.report = {
            "status": pose.status,
            "rms_m": fit.rms_m if fit else 0.0,
            "inlier_share": fit.inlier_share if fit else 0.0,
        }
        if pose.doubt:
            self.report["doubt"] = pose.doubt
        return dataclasses.replace(frame, T_WC=pose.T_WC.to(frame.T_WC))

    @property
    def is_before_first_look(self) -> bool:
        """Whether the camera was not yet found in the map of an earlier run."""
        return self.is_tracking and bool(self.poses) and not self._tracker.has_pose

    def go_on_in(
        self,
        poses: list[Float[Tensor, "4 4"]],
        frame_indices: list[int],
        places: tracking.Places,
        camera: Camera,
    ) -> None:
        """Begin in the map of an earlier run: a tracked camera is looked for in it by appearance.

        Args:
            poses, frame_indices: Of the frames of that run, before those to come.
            places: Its keyframes.
            camera: Of the frames to come.
        """
        self.poses = [self._in_block(T_WC.cpu()) for T_WC in poses]
        self.given_poses = list(self.poses)
        self.frame_indices = list(frame_indices)
        self._tracker = tracking.Tracker(self.config)
        self.memory = KeyframeMemory(self.config)
        self.memory.begin_with(places, camera)

    def take_back(self, *, was_refused: bool = False) -> None:
        """Undo the last ``locate``, because its frame was not mapped.

        Args:
            was_refused: The frame cannot be used. A frame that could not be tracked then counts as
                lost.
        """
        if self._earlier_state is not None and not (was_refused and not self.report):
            self._tracker.standing = self._earlier_state
        self._earlier_state = None

    def record(self, frame: Frame) -> tracking.Correction | None:
        """Add a mapped frame to the trajectory. If it closed a loop, returns the correction
        (applied to ``poses``)."""
        self._earlier_state = None
        self.poses.append(self._in_block(frame.T_WC_cpu))
        self.given_poses.append(self.poses[-1])
        self.frame_indices.append(frame.index)
        if not self.is_tracking:
            self._jumps.record(frame)
            self.memory.collect(frame)
            return None
        return self._apply(self.memory.add(frame))

    def _in_block(self, T_WC: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """A copy of the pose inside a larger tensor.

        A small tensor of its own per frame, between the large ones of the frames, would prevent the
        allocator from reusing the frames' memory: measured, 50 to 220 kB lost per frame of 160x120.
        """
        n = self._n_in_blocks % _BLOCK
        if n == 0:
            self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_in_blocks += 1
        return self._block[n].copy_(T_WC)

    def finish(self) -> tracking.Correction | None:
        """The last optimisation of the back end, over all keyframes and landmarks, after the
        scan."""
        return self._apply(self.memory.finish())

    def _apply(self, correction: tracking.Correction | None) -> tracking.Correction | None:
        if correction is None:
            return None
        moves = correction.transform_of(torch.tensor(self.frame_indices)).float()
        old_poses = self.poses
        self.poses = [T @ pose for T, pose in zip(moves, old_poses, strict=True)]
        pairs = zip(moves, self.poses, old_poses, self.given_poses, strict=True)
        self.given_poses = [
            T_new if T_given is T_old else T @ T_given for T, T_new, T_old, T_given in pairs
        ]
        self._tracker.correct(moves[-1])
        return correction

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue."""
        return {
            "poses": torch.stack(self.poses) if self.poses else torch.zeros(0, 4, 4),
            "given": torch.stack(self.given_poses) if self.is_refined else None,
            "frame_indices": torch.tensor(self.frame_indices, dtype=torch.int64),
            "stands": self._jumps.state_dict(),
            "tracker": self._tracker.state_dict(),
        } | self.memory.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.frame_indices = state["frame_indices"].tolist()
        self.poses = [self._in_block(T_WC) for T_WC in state["poses"].cpu()]
        self.given_poses = list(self.poses)
        if state["given"] is not None:
            self.given_poses = [self._in_block(T_WC) for T_WC in state["given"].cpu()]
        self._jumps.load_state_dict(state["stands"])
        self._tracker = tracking.Tracker.from_state_dict(self.config, state["tracker"])
        self.memory.load_state_dict(state)


def between(
    indices: Int[Tensor, " R"], values: Float[Tensor, "R D"], index: int
) -> Float[Tensor, " D"]:
    """Values at increasing numbers of frames, interpolated for another frame; outside of them the
    first or last."""
    row = int(torch.searchsorted(indices, index).clamp(1, max(len(indices) - 1, 1)))
    if len(indices) == 1:
        return values[0]
    first = int(indices[row - 1])
    last = int(indices[row])
    share = min(max((index - first) / max(last - first, 1), 0.0), 1.0)
    return (1 - share) * values[row - 1] + share * values[row]


def move_map(
    correction: tracking.Correction, gaussians: GaussianModel, keyframes: KeyframeList
) -> None:
    """Move Gaussians and keyframes with a corrected trajectory: each with the keyframes around its
    frame."""
    move_map_(gaussians, correction.transform_of(gaussians.birth_frame))
    if len(keyframes):
        keyframes.move(correction.transform_of(torch.tensor([k.index for k in keyframes])))
