"""The camera's walk through a building of equal rooms, which are walked through one after
another."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from .camera import disturbed_poses, walk

ROOM_DISTANCE_M = 10.0

ROOM_TIME_S = 60.0
"""Between the rooms of a building, and between their first frames."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildingWalk:
    """Where the camera was at each frame, where it is said to have been, and when.

    Fields are the options of ``RoomSequence`` with these names; N is ``rooms * n_frames``.
    """

    trajectory: str
    n_frames: int
    rooms: int
    seed: int
    pose_error_m: float
    pose_error_deg: float
    pose_delay_s: float

    @property
    def rooms_W(self) -> Float64[ndarray, "rooms 3"]:
        """Where the rooms of the building are, world frame, metres."""
        room = np.arange(self.rooms)
        side = math.ceil(math.sqrt(self.rooms))
        return ROOM_DISTANCE_M * np.stack([room % side, room // side, 0 * room], 1)

    @property
    def poses(self) -> Float64[ndarray, "N 4 4"]:
        """Camera-to-world poses that the frames were taken at."""
        return self._poses_and_times[0]

    @property
    def times_s(self) -> Float64[ndarray, " N"]:
        """Time of every frame, seconds."""
        return self._poses_and_times[1]

    @functools.cached_property
    def given_poses(self) -> Float64[ndarray, "N 4 4"]:
        """Camera-to-world poses that come with the frames, with error and delay."""
        poses = self.poses
        if self.pose_delay_s:
            poses = self._in_all_rooms(
                walk(self.trajectory, self.n_frames, self.seed, delay_s=self.pose_delay_s)[0]
            )
        if self.pose_error_m or self.pose_error_deg:
            poses = disturbed_poses(
                poses, self.times_s, self.pose_error_m, self.pose_error_deg, self.seed
            )
        return poses

    @functools.cached_property
    def _poses_and_times(self) -> tuple[Float64[ndarray, "N 4 4"], Float64[ndarray, " N"]]:
        poses, times_s = walk(self.trajectory, self.n_frames, self.seed)
        starts_s = ROOM_TIME_S * np.arange(self.rooms)[:, None]
        return self._in_all_rooms(poses), (starts_s + times_s).reshape(-1)

    def _in_all_rooms(self, poses: Float64[ndarray, "n 4 4"]) -> Float64[ndarray, "N 4 4"]:
        """The poses of a walk through one room in one room after another."""
        poses = np.tile(poses, (self.rooms, 1, 1))
        poses[:, :3, 3] += self.rooms_W.repeat(self.n_frames, 0)
        return poses
