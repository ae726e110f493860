"""The pose of every frame: as recorded, or from a file, one per frame or interpolated at the
frame's time."""

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...data.recorded.pose_headers import metres_per_unit
from ...data.recorded.poses import checked_pose
from ...errors import SequenceError
from ...files import read_text
from .pose_list import poses_per_frame
from .recording import ConvertOptions, OptionNeeded, RecordedFrame, Recording
from .trajectory import RecordedTrajectory, camera_in_body, frame_key, read_trajectory


class FramePoses:
    """Pose of each frame: the recorded one, or one from a file, by its place or at its time; scaled
    to metres and checked."""

    def __init__(self, recording: Recording, options: ConvertOptions):
        self.trajectory: RecordedTrajectory | None = None
        self._per_frame: dict[Any, Tensor] | None = None
        self.none = options.poses == "none"
        self._offset_s = options.time_offset_s
        self._recording = recording
        self.notes: list[str] = []
        file = "" if self.none else options.poses or recording.poses_file
        if file:
            self._T_body_cam = camera_in_body(options.T_cam_body, options.T_body_cam)
            per_frame = poses_per_frame(Path(file), recording, options)
            if per_frame is not None:
                self._per_frame, notes = per_frame
                self.notes += notes
        if file and self._per_frame is not None:
            self.notes.append(
                f"{file}: one pose per frame, taken as camera-to-world, OpenCV axes, metres"
            )
        elif file:
            self.trajectory = read_trajectory(
                Path(file),
                time_unit=options.pose_time_unit,
                quaternions=options.pose_quaternions,
                max_gap_s=options.max_gap_s,
                T_body_cam=self._T_body_cam,
                frame_time_s=_first_time(recording),
            )
            self.notes += self.trajectory.notes
        elif not self.none and not recording.has_poses:
            raise OptionNeeded(
                f"{recording.name} holds no poses; give a trajectory with --poses FILE (TUM, "
                "OKVIS2, ORB-SLAM3, "
                "EuRoC, or one pose per frame), or --poses none to track the camera later",
                option="poses",
                question="Which file holds the poses? none: they are estimated by tracking the "
                "camera",
            )
        self._scale = 1.0 if self.none else self._metres_per_unit(options, file)

    @property
    def by_place(self) -> bool:
        """Whether a pose is that of a colour image and of its depth, whenever they were taken."""
        return self._per_frame is not None

    def timed(self, frame: RecordedFrame) -> RecordedFrame:
        """The frame with the time that the trajectory gives for its number, where the recording has
        no times."""
        trajectory = self.trajectory
        if trajectory is None or frame.time_s is not None or trajectory.counts_frames:
            return frame
        return replace(
            frame, time_s=trajectory.time_of_frame.get(frame_key(Path(frame.source).stem))
        )

    def of(
        self,
        place: int,
        frame: RecordedFrame,
    ) -> tuple[Float[Tensor, "4 4"] | None, str]:
        """Pose of the frame at a place of the recording, or None and why there is none; float64,
        metres."""
        if self._per_frame is not None:
            T = self._per_frame.get(place)
            reason = "no pose of its name"
            T = self._per_frame.get(frame_key(Path(frame.source).stem)) if T is None else T
            T = T if T is None or self._T_body_cam is None else T @ self._T_body_cam
        elif self.trajectory is not None:
            T, reason = self._of_trajectory(self.trajectory, frame)
        else:
            T = frame.T_WC
            reason = "no pose"
        if T is None:
            return None, reason
        if not bool(torch.isfinite(T).all()):
            return None, "tracking was lost (pose is NaN or infinite)"
        T = T.double().clone()
        T[:3, 3] *= self._scale
        checked_pose(T, f"the pose of {frame.source}")
        return T, ""

    def _of_trajectory(
        self, trajectory: "RecordedTrajectory", frame: RecordedFrame
    ) -> tuple[Float[Tensor, "4 4"] | None, str]:
        """The pose at the time of a frame, or, where the frame has no time, of its number."""
        if frame.time_s is not None:
            return trajectory.pose_at(
                frame.time_s + self._offset_s
            ), "the trajectory has no pose around its time"
        if not trajectory.time_of_frame:
            raise SequenceError(
                f"{trajectory.path} gives poses by time, but {frame.source} has none; expected "
                "image names or lists with times; --poses none tracks the camera later"
            )
        time_s = trajectory.time_of_frame.get(frame_key(Path(frame.source).stem))
        return None if time_s is None else trajectory.pose_at(
            time_s
        ), "the trajectory has no pose of its number"

    def _metres_per_unit(self, options: ConvertOptions, file: str) -> float:
        if options.scale:
            self.notes.append(f"positions were multiplied by {options.scale:g} (--scale)")
            return options.scale
        told = _metres_of_header(Path(file)) if file else None
        if told is not None:
            self.notes.append(
                f"positions were multiplied by {told:g}, as the header of {file} says (--scale)"
            )
            return told
        if self.trajectory is not None or not self._recording.up_to_scale:
            return 1.0
        scale = 1.0
        sentence = "nothing to measure it on"
        if self._recording.measured_scale is not None:
            scale, sentence = self._recording.measured_scale()
        self.notes.append(
            f"these poses have no unit of length; one unit is taken as {scale:.6g} m ({sentence}; "
            "--scale)"
        )
        return scale


def _metres_of_header(file: Path) -> float | None:
    """Metres of one unit of the positions, where the header of a text file names another unit."""
    if file.is_dir() or file.suffix == ".npy":
        return None
    return metres_per_unit(read_text(file, "poses").splitlines())


def _first_time(recording: Recording) -> float | None:
    """When the first frame was taken, seconds; None where the recording has no times."""
    with contextlib.suppress(SequenceError):
        return next((frame.time_s for frame in recording.frames()), None)
    return None
