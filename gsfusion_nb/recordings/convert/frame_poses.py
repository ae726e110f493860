"""The pose of every frame of a recording that is converted."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...data.recorded.poses import checked_pose
from ...data.sequence import SequenceError
from .options import ConvertOptions
from .recording import RecordedFrame, Recording
from .trajectory import Trajectory, camera_in_body, read_trajectory


class FramePoses:
    """Pose of each frame: the recorded one, or one from a separate trajectory at its time; scaled to metres and
    checked."""

    def __init__(self, recording: Recording, options: ConvertOptions):
        self.trajectory: Trajectory | None = None
        self.none = options.poses == "none"
        self._offset_s = options.time_offset_s
        self._recording = recording
        self.notes: list[str] = []
        if options.poses and not self.none:
            self.trajectory = read_trajectory(
                Path(options.poses),
                time_unit=options.pose_time_unit,
                max_gap_s=options.max_gap_s,
                T_body_cam=camera_in_body(options.T_cam_body, options.T_body_cam),
            )
            self.notes += self.trajectory.notes
        elif not self.none and not recording.has_poses:
            raise SequenceError(
                f"{recording.name} holds no poses; give a trajectory with --poses FILE (TUM, OKVIS2, ORB-SLAM3, "
                "EuRoC), or --poses none to track the camera later"
            )
        self._scale = 1.0 if self.none else self._metres_per_unit(options)

    def of(self, frame: RecordedFrame) -> tuple[Float[Tensor, "4 4"] | None, str]:
        """Pose, or None and the reason why there is none; float64, metres."""
        if self.trajectory is not None:
            if frame.time_s is None:
                raise SequenceError(
                    f"{frame.source} has no time, which --poses needs; expected a format with times, or image names "
                    "that are times"
                )
            T = self.trajectory.pose_at(frame.time_s + self._offset_s)
            reason = "the trajectory has no pose around its time"
        else:
            T, reason = frame.T_WC, "no pose"
        if T is None:
            return None, reason
        if not bool(torch.isfinite(T).all()):
            return None, "tracking was lost (pose is NaN or infinite)"
        T = T.double().clone()
        T[:3, 3] *= self._scale
        checked_pose(T, f"the pose of {frame.source}")
        return T, ""

    def _metres_per_unit(self, options: ConvertOptions) -> float:
        if options.scale:
            self.notes.append(f"positions were multiplied by {options.scale:g} (--scale)")
            return options.scale
        if self.trajectory is not None or not self._recording.up_to_scale:
            return 1.0
        scale, sentence = 1.0, "nothing to measure it on"
        if self._recording.measured_scale is not None:
            scale, sentence = self._recording.measured_scale()
        self.notes.append(
            f"these poses have no unit of length; one unit is taken as {scale:.6g} m ({sentence}; --scale)"
        )
        return scale
