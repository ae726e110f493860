"""The poses of a ROS bag: from the transform tree, or from a topic of poses."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....errors import SequenceError
from ..recording import ConvertOptions, OptionNeeded
from ..trajectory import RecordedTrajectory, camera_in_body
from .ros_tf import TransformPath, TransformTree, in_order, pose_rows, seconds

PoseAt = Callable[[float], Float[Tensor, "4 4"] | None]
"""Function from a time, seconds, to the camera's pose; None where it is unknown."""


@dataclass
class PoseTopic:
    """The messages of one topic of poses."""

    body: str = ""
    """Frame whose poses they are, where the messages say it."""
    times_s: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)

    def add(self, message: Any) -> None:
        """Take a message."""
        row, self.body = pose_rows(message)
        self.times_s.append(seconds(message.header.stamp))
        self.rows.append(row)


@dataclass(frozen=True, kw_only=True)
class RosPoses:
    """Finds the poses of the colour camera of a bag."""

    path: Path
    camera: str
    """Frame of the colour images."""
    times_s: list[float]
    """Of the colour images."""
    tree: TransformTree
    topics: dict[str, PoseTopic]
    options: ConvertOptions
    notes: list[str]
    """What was taken is added to these sentences."""

    def find(self) -> tuple[PoseAt | None, str]:
        """The poses, and where they come from: "tf" or a topic. None without any, or where others
        are given.

        Raises:
            OptionNeeded: there are poses, and the bag does not say how they belong to the camera.
            SequenceError: the topic or the world of the options is not in the bag, or several
                topics may be meant.
        """
        pose_topic = self.options.ros.pose_topic
        if self.options.poses:
            return None, ""
        if pose_topic not in ("", "tf"):
            return self._of_topic(pose_topic), pose_topic
        way = self._way()
        if way is not None and (self.tree.moves(way) or pose_topic == "tf" or not self.topics):
            return self._of_tree(way), "tf"
        if pose_topic == "tf" or not self.topics:
            return None, ""
        topic = self._topic()
        return self._of_topic(topic), topic

    def _way(self) -> TransformPath | None:
        world_frame = self.options.ros.world_frame
        worlds = [world_frame] if world_frame else self.tree.worlds(self.camera)
        times_s = torch.tensor(self.times_s, dtype=torch.float64)
        way = self.tree.best_path(self.camera, worlds, times_s, self.options.max_gap_s)
        if way is None and world_frame:
            raise SequenceError(
                f"{self.path}: tf does not lead from the camera's frame {shown(self.camera)} to "
                f"{shown(world_frame)}; its frames: {', '.join(sorted(self.tree.frames)) or 'none'}"
            )
        return way

    def _of_tree(self, way: TransformPath) -> PoseAt:
        others = [world for world in self.tree.worlds(self.camera) if world != way.world]
        note = f"poses of {shown(self.camera)} in {shown(way.world)} from the transform tree"
        if others and not self.options.ros.world_frame:
            others_text = ", ".join(shown(world) for world in others)
            note += f" ({way}); it also leads to {others_text} (--ros.world-frame)"
        self.notes.append(note)
        if not self.tree.moves(way):
            self.notes.append(
                f"no transform between {shown(self.camera)} and {shown(way.world)} changes: it "
                "stands"
            )
        self._note_conflicts(self.tree.conflicts(way), "transforms")
        return lambda time_s: self.tree.along(way, time_s, self.options.max_gap_s)

    def _topic(self) -> str:
        """The topic of poses to take where the transform tree has none of the camera."""
        names = sorted(self.topics)
        bodies = {name: self.topics[name].body for name in names}
        linked_topics = [
            name for name in names if bodies[name] and self._T_body_cam(bodies[name]) is not None
        ]
        if len(linked_topics) == 1:
            return linked_topics[0]
        topics_text = ", ".join(
            f"{name} (of {bodies[name]})" if bodies[name] else name for name in names
        )
        if len(names) > 1 and not self.tree.has_motion:
            raise SequenceError(
                f"{self.path} must have one pose topic, found: {topics_text}; name one with "
                "--ros.pose-topic"
            )
        is_given = bool(self.options.T_body_cam or self.options.T_cam_body)
        if not self.tree.has_motion and (is_given or not bodies[names[0]]):
            return names[0]
        if not self.tree.has_motion:
            raise self._needed(
                f"{self.path} does not say where the colour camera, {shown(self.camera)}, is in "
                f"the body of {topics_text}"
            )
        place = "does not know" if self.camera not in self.tree.frames else "does not move"
        raise self._needed(
            f"{self.path}: tf {place} the camera's frame {shown(self.camera)} (its frames: "
            f"{', '.join(sorted(self.tree.frames))}), but there are poses in {topics_text}"
        )

    def _needed(self, why: str) -> OptionNeeded:
        return OptionNeeded(
            f"{why}; take a topic of poses with --ros.pose-topic, and say where the camera is in "
            "its body with --T-body-cam; or --poses none tracks the camera later",
            option="poses",
            question=f"{why} (--ros.pose-topic, --T-body-cam). Which file holds the poses? none: "
            "they are estimated by tracking the camera",
        )

    def _of_topic(self, name: str) -> PoseAt | None:
        topic = self.topics.get(name)
        if topic is None:
            topics_text = ", ".join(sorted(self.topics)) or "none"
            raise SequenceError(
                f"{self.path} has no pose topic {shown(name)}; it has {topics_text}"
            )
        if not topic.rows:
            return None
        timed_rows = in_order(topic.times_s, topic.rows)
        T_body_cam = camera_in_body(self.options.T_cam_body, self.options.T_body_cam)
        if T_body_cam is None:
            T_body_cam = self._T_body_cam(topic.body)
        if T_body_cam is None:
            whose = f" of {shown(topic.body)}" if topic.body else ""
            self.notes.append(
                f"the poses of {name}{whose} are taken as those of the colour camera (OpenCV "
                "axes); if they are poses of a body, give --T-body-cam"
            )
            T_body_cam = torch.eye(4, dtype=torch.float64)
        self._note_conflicts(timed_rows.conflicts, f"poses of {name}")
        return RecordedTrajectory(
            path=name,
            stamps_s=timed_rows.times_s,
            T_world_body=timed_rows.poses,
            T_body_cam=T_body_cam,
            max_gap_s=self.options.max_gap_s,
        ).pose_at

    def _T_body_cam(self, body: str) -> Float[Tensor, "4 4"] | None:
        """Pose of the camera in the body, from transforms that do not change; None where it is
        unknown."""
        if not body:
            return None
        return (
            torch.eye(4, dtype=torch.float64)
            if body == self.camera
            else self.tree.between(self.camera, body)
        )

    def _note_conflicts(self, n: int, what: str) -> None:
        if n:
            self.notes.append(
                f"{n} {what} have the time of another one and differ from it; the first was taken"
            )
