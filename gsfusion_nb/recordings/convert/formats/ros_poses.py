"""Camera poses from a ROS bag: the transform tree (tf, tf_static), or a topic of poses."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.recorded.poses import interpolate_rows, matrices
from ....data.sequence import SequenceError

POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")


@dataclass
class _Edge:
    """Transforms from a frame to its parent."""

    parent: str
    static: bool
    times_s: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


class TransformTree:
    """Transforms between frames over time, as in tf."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._sorted: dict[str, tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]] = {}

    def add(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a TFMessage."""
        for t in message.transforms:
            child, parent = (name.lstrip("/") for name in (t.child_frame_id, t.header.frame_id))
            edge = self._edges.setdefault(child, _Edge(parent, static))
            edge.times_s.append(seconds(t.header.stamp))
            edge.rows.append(_row(t.transform.translation, t.transform.rotation))
        self._sorted.clear()

    def root(self, frame: str) -> str:
        """The frame above ``frame`` that has no parent."""
        return self._chain(frame)[-1]

    def knows(self, frame: str, ancestor: str) -> bool:
        """Whether ``ancestor`` lies on the path from ``frame`` to the root."""
        return ancestor in self._chain(frame)

    def moves(self, frame: str, ancestor: str) -> bool:
        """Whether some transform between the two changes over time."""
        chain = self._chain(frame)
        return any(not self._edges[f].static for f in chain[: chain.index(ancestor)])

    def lookup(self, frame: str, ancestor: str, time_s: float, max_gap_s: float) -> Float[Tensor, "4 4"] | None:
        """Transform from ``frame`` to ``ancestor``; None where a moving one is unknown at that time. float64."""
        T = torch.eye(4, dtype=torch.float64)
        chain = self._chain(frame)
        for name in chain[: chain.index(ancestor)]:
            stamps, rows = self._rows(name)
            one = self._edges[name].static or len(rows) == 1
            row = rows[-1] if one else interpolate_rows(stamps, rows, time_s, max_gap_s=max_gap_s)
            if row is None:
                return None
            T = matrices(row[None])[0] @ T
        return T

    def between(self, frame: str, other: str) -> Float[Tensor, "4 4"] | None:
        """Transform from ``frame`` to ``other`` through fixed transforms only, float64; or None."""
        common = next((f for f in self._chain(frame) if self.knows(other, f)), None)
        if common is None or self.moves(frame, common) or self.moves(other, common):
            return None
        up, down = (self.lookup(f, common, 0.0, 0.0) for f in (frame, other))
        return None if up is None or down is None else torch.linalg.inv(down) @ up

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def _rows(self, name: str) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]:
        if name not in self._sorted:
            edge = self._edges[name]
            self._sorted[name] = in_order(edge.times_s, edge.rows)
        return self._sorted[name]


def pose_rows(message: Any) -> tuple[list[float], str]:
    """``tx ty tz qx qy qz qw`` of a pose message, and the frame whose pose it is ("" where the message has none)."""
    if hasattr(message, "transform"):
        return _row(message.transform.translation, message.transform.rotation), message.child_frame_id.lstrip("/")
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose
    return _row(pose.position, pose.orientation), getattr(message, "child_frame_id", "").lstrip("/")


def in_order(times_s: list[float], rows: list[list[float]]) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]:
    """Finite rows by increasing time, each time once (messages may arrive out of order). float64"""
    t, table = torch.tensor(times_s, dtype=torch.float64), torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)
    usable = torch.isfinite(table).all(dim=1) & ((table[:, 3:].norm(dim=1) - 1).abs() < 1e-2)
    if not bool(usable.any()):
        raise SequenceError("every pose of the bag is NaN or has no unit quaternion; expected geometry_msgs poses")
    t, table = t[usable], table[usable]
    order = t.argsort(stable=True)
    t, table = t[order], table[order]
    first = torch.cat([torch.ones(1, dtype=torch.bool), t[1:] > t[:-1]])
    return t[first].contiguous(), table[first]


def seconds(stamp: Any) -> float:
    """Seconds of a ROS time."""
    return int(stamp.sec) + int(stamp.nanosec) * 1e-9


def _row(position: Any, rotation: Any) -> list[float]:
    return [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
