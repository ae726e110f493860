"""Transforms between frames over time (tf), and poses from topics.

A transform is known by its frame and the parent that it is given in. Two publishers may give one
frame two parents, such as odometry and localisation: these are two transforms, of two worlds.
"""

import functools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ....data.recorded.poses import matrices
from ....errors import SequenceError
from ....geometry.pose_path import pose_at

POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")
_STILL = 1e-9
"""Rows of a transform that differ by less do not move."""


@dataclass(frozen=True, eq=False)
class TimedRows:
    """Rows ``tx ty tz qx qy qz qw`` at increasing times, each time once."""

    times_s: Float[Tensor, " N"]
    rows: Float[Tensor, "N 7"]
    conflicts: int = 0
    """Rows that were left out, because another one of the same time says something else and came
    first."""

    @functools.cached_property
    def poses(self) -> Float[Tensor, "N 4 4"]:
        """The rows as matrices, float64."""
        return matrices(self.rows)


@dataclass
class _Transform:
    """Transforms from a frame to one of its parents, in the order in which they came."""

    is_static: bool
    times_s: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    _ordered: TimedRows | None = None

    def add(self, time_s: float, row: list[float]) -> None:
        """Add a row."""
        self.times_s.append(time_s)
        self.rows.append(row)
        self._ordered = None

    @property
    def ordered(self) -> TimedRows:
        """Its rows by increasing time."""
        if self._ordered is None:
            self._ordered = in_order(self.times_s, self.rows)
        return self._ordered

    @property
    def moves(self) -> bool:
        """Whether it has been seen to change."""
        rows = self.ordered.rows
        return not self.is_static and float((rows - rows[:1]).abs().max()) > _STILL

    def covers(
        self,
        times_s: Float[Tensor, " T"],
        max_gap_s: float,
    ) -> Bool[Tensor, " T"]:
        """Whether it is known at each of the times."""
        if not self.moves:
            return torch.ones_like(times_s, dtype=torch.bool)
        stamps_s = self.ordered.times_s
        right = torch.searchsorted(stamps_s, times_s)
        is_exact = stamps_s[right.clamp(max=len(stamps_s) - 1)] == times_s
        between = (right > 0) & (right < len(stamps_s))
        gap = (
            stamps_s[right.clamp(1, len(stamps_s) - 1)]
            - stamps_s[right.clamp(1, len(stamps_s) - 1) - 1]
        )
        return is_exact | (between & (gap <= max_gap_s))

    def at(self, time_s: float, max_gap_s: float) -> Float[Tensor, "4 4"] | None:
        """The transform at a time, the last one if it does not move; None where it is unknown."""
        if not self.moves:
            return self.ordered.poses[-1]
        return pose_at(self.ordered.times_s, self.ordered.poses, time_s, max_gap_s=max_gap_s)


@dataclass(frozen=True)
class TransformPath:
    """A way from a frame up to one of those above it: the frames, from below."""

    frames: tuple[str, ...]

    @property
    def world(self) -> str:
        """The uppermost frame."""
        return self.frames[-1]

    def __str__(self) -> str:
        return " <- ".join(reversed(self.frames))

    def edges(self) -> Iterator[tuple[str, str]]:
        """Frame and parent of each step."""
        return zip(self.frames, self.frames[1:], strict=False)


class TransformTree:
    """Transforms between frames over time, as in tf, where a frame may have several parents."""

    def __init__(self) -> None:
        self._transforms: dict[tuple[str, str], _Transform] = {}

    def add(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a TFMessage."""
        for t in message.transforms:
            child, parent = (name.lstrip("/") for name in (t.child_frame_id, t.header.frame_id))
            transform = self._transforms.setdefault((child, parent), _Transform(static))
            transform.is_static &= static
            transform.add(
                seconds(t.header.stamp), row_of(t.transform.translation, t.transform.rotation)
            )

    @property
    def frames(self) -> set[str]:
        """Every frame that a transform names."""
        return {frame for edge in self._transforms for frame in edge}

    @property
    def has_motion(self) -> bool:
        """Whether any transform has been seen to change."""
        return any(transform.moves for transform in self._transforms.values())

    def worlds(self, frame: str) -> list[str]:
        """The frames above ``frame`` that have no parent, and itself where it has none."""
        return list(
            dict.fromkeys(path.world for path in self.paths(frame) if not self._parents(path.world))
        )

    def paths(self, frame: str, world: str | None = None) -> list[TransformPath]:
        """Every way from ``frame`` upwards, or every one that ends at ``world``."""
        ways: list[TransformPath] = []
        waiting: deque[tuple[str, ...]] = deque([(frame,)])
        while waiting:
            frames = waiting.popleft()
            ways.append(TransformPath(frames))
            waiting.extend(
                (*frames, parent) for parent in self._parents(frames[-1]) if parent not in frames
            )
        return [path for path in ways if world in (None, path.world)]

    def best_path(
        self,
        frame: str,
        worlds: Sequence[str],
        times_s: Float[Tensor, " T"],
        max_gap_s: float,
    ) -> TransformPath | None:
        """The way to one of the worlds on which the frame moves, and is known at the most of the
        times; None without any. Of equal ways the one with the most transforms."""

        def rank(path: TransformPath) -> tuple[bool, int, int]:
            steps = [self._transforms[edge] for edge in path.edges()]
            is_covered = torch.ones_like(times_s, dtype=torch.bool)
            for step in steps:
                is_covered &= step.covers(times_s, max_gap_s)
            return (
                any(step.moves for step in steps),
                int(is_covered.sum()),
                sum(len(step.rows) for step in steps),
            )

        ways = [
            path for world in worlds for path in self.paths(frame, world) if len(path.frames) > 1
        ]
        return max(ways, key=rank, default=None)

    def moves(self, path: TransformPath) -> bool:
        """Whether a transform on the way has been seen to change."""
        return any(self._transforms[edge].moves for edge in path.edges())

    def conflicts(self, path: TransformPath) -> int:
        """Transforms on the way that were left out, because another one of the same time came
        first."""
        return sum(
            self._transforms[edge].ordered.conflicts
            for edge in path.edges()
            if self._transforms[edge].moves
        )

    def along(
        self, path: TransformPath, time_s: float, max_gap_s: float
    ) -> Float[Tensor, "4 4"] | None:
        """Transform from the lowest frame of the way to its world; None where it is unknown at that
        time. float64."""
        T = torch.eye(4, dtype=torch.float64)
        for edge in path.edges():
            step = self._transforms[edge].at(time_s, max_gap_s)
            if step is None:
                return None
            T = step @ T
        return T

    def between(self, frame: str, other: str) -> Float[Tensor, "4 4"] | None:
        """Transform from ``frame`` to ``other`` through transforms that do not change, float64; or
        None."""
        T_of = {frame: torch.eye(4, dtype=torch.float64)}
        waiting = deque([frame])
        while waiting and other not in T_of:
            frame_here = waiting.popleft()
            for (child, parent), transform in self._transforms.items():
                if frame_here not in (child, parent) or transform.moves:
                    continue
                frame_there = parent if frame_here == child else child
                T_parent_child = transform.ordered.poses[-1]
                if frame_there not in T_of:
                    T_of[frame_there] = (
                        T_parent_child if frame_here == child else torch.linalg.inv(T_parent_child)
                    ) @ T_of[frame_here]
                    waiting.append(frame_there)
        return T_of.get(other)

    def _parents(self, frame: str) -> list[str]:
        return [parent for child, parent in self._transforms if child == frame]


def pose_rows(message: Any) -> tuple[list[float], str]:
    """``tx ty tz qx qy qz qw`` of a pose message, and the frame whose pose it is ("" where the
    message has none)."""
    if hasattr(message, "transform"):
        return row_of(
            message.transform.translation, message.transform.rotation
        ), message.child_frame_id.lstrip("/")
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose
    return row_of(pose.position, pose.orientation), getattr(message, "child_frame_id", "").lstrip(
        "/"
    )


def in_order(times_s: list[float], rows: list[list[float]]) -> TimedRows:
    """Finite rows by increasing time, each time once (messages may arrive out of order). float64"""
    t = torch.tensor(times_s, dtype=torch.float64)
    table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)
    usable = torch.isfinite(table).all(dim=1) & ((table[:, 3:].norm(dim=1) - 1).abs() < 1e-2)
    if not bool(usable.any()):
        raise SequenceError(
            "every pose of the bag is NaN or has no unit quaternion; expected geometry_msgs poses"
        )
    t = t[usable]
    table = table[usable]
    order = t.argsort(stable=True)
    t = t[order]
    table = table[order]
    first = torch.cat([torch.ones(1, dtype=torch.bool), t[1:] > t[:-1]])
    first_rows = table[first][first.cumsum(0) - 1]
    conflicts = int(((table - first_rows).abs().amax(dim=1) > _STILL).sum())
    return TimedRows(t[first].contiguous(), table[first], conflicts)


def seconds(stamp: Any) -> float:
    """Seconds of a ROS time."""
    return int(stamp.sec) + int(stamp.nanosec) * 1e-9


def row_of(position: Any, rotation: Any) -> list[float]:
    """``tx ty tz qx qy qz qw`` of a position and a quaternion."""
    return [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
