"""The pose of each frame, given by the data or tracked against the map."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .. import tracking
from ..config import TrackingConfig
from ..errors import BadFrameError
from ..gaussians import GaussianModel
from ..gaussians.rigid_motion import move_map_
from ..optim import KeyframeList
from ..types import Camera, Frame
from .keyframe_memory import KeyframeMemory
from .pose_jumps import PoseJumps
from .trajectory import Trajectory


class Localiser:
    """Finds the pose of each frame and records it in the trajectory.

    With ``config.poses == "given"`` a frame keeps its pose. With "tracked" only the first does; the
    others are aligned to the map (Peng et al. 2024, Eq. 10), and the back end, where enabled,
    corrects the trajectory when a loop closes.
    """

    def __init__(self, config: TrackingConfig):
        self.config = config
        self.is_tracking = config.poses == "tracked"
        """Whether poses are estimated."""
        self.trajectory = Trajectory()
        """The pose of every mapped frame."""
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
        self.followers: list[Callable[[tracking.Correction], None]] = []
        """Called with each correction of the trajectory, after it moved: what lies in the world
        moves with it."""

    @property
    def frames_lost(self) -> int:
        """Number of frames in a row that could not be tracked, up to the last one; 0 if that one
        was."""
        return self._tracker.lost_in_a_row

    def places(self) -> tracking.Places | None:
        """What finds a camera again in this map: keyframes with their poses as they are by now;
        None if there are none."""
        if self.is_tracking:
            return self.memory.places({})
        poses = zip(self.trajectory.frame_indices, self.trajectory.poses, strict=True)
        return self.memory.places(dict(poses))

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
        return self.is_tracking and bool(self.trajectory.poses) and not self._tracker.has_pose

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
        self.trajectory.begin_with(poses, frame_indices)
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

    def record(self, frame: Frame) -> None:
        """Add a mapped frame to the trajectory. If it closes a loop, the trajectory and its
        ``followers`` move."""
        self._earlier_state = None
        self.trajectory.add(frame)
        if not self.is_tracking:
            self._jumps.record(frame)
            self.memory.collect(frame)
            return
        self._apply(self.memory.add(frame))

    def finish(self) -> None:
        """The last optimisation of the back end, over all keyframes and landmarks, after the scan.
        The trajectory and its ``followers`` move."""
        self._apply(self.memory.finish())

    def _apply(self, correction: tracking.Correction | None) -> None:
        if correction is None:
            return
        indices = torch.tensor(self.trajectory.frame_indices)
        moves = correction.transform_of(indices).float()
        self.trajectory.move(moves)
        self._tracker.correct(moves[-1])
        for follow in self.followers:
            follow(correction)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue."""
        return {
            **self.trajectory.state_dict(),
            "stands": self._jumps.state_dict(),
            "tracker": self._tracker.state_dict(),
            **self.memory.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.trajectory.load_state_dict(state)
        self._jumps.load_state_dict(state["stands"])
        self._tracker = tracking.Tracker.from_state_dict(self.config, state["tracker"])
        self.memory.load_state_dict(state)


def move_map(
    correction: tracking.Correction, gaussians: GaussianModel, keyframes: KeyframeList
) -> None:
    """Move Gaussians and keyframes with a corrected trajectory: each with the keyframes around its
    frame."""
    move_map_(gaussians, correction.transform_of(gaussians.birth_frame))
    if len(keyframes):
        keyframes.move(correction.transform_of(torch.tensor([k.index for k in keyframes])))
