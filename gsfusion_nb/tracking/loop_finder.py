"""Finds earlier keyframes that show the same place as a new one, and the relative poses."""

import logging
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import BackEndConfig
from ..geometry import se3
from .keyframe_database import KeyframeDatabase
from .landmarks import SEARCH_SHARE, Landmarks
from .loop_checks import depth_thumbnail, path_between, why_not_same_place
from .matching import RelativePose, refine_pose

log = logging.getLogger(__name__)

CANDIDATES = 3
"""Loops are searched in this many of the most similar keyframes and in the one whose pose is nearest."""

AROUND = 2
"""A loop uses the landmarks of this many keyframes before and after the earlier keyframe."""


class LoopFinder:
    """Finds loops from the keyframes of ``database``, by appearance, landmarks and depth."""

    def __init__(self, config: BackEndConfig, database: KeyframeDatabase, landmarks: Landmarks):
        self.config, self.database, self.landmarks = config, database, landmarks
        self.thumbnails: list[Tensor] = []
        """Small depth images of the keyframes, in the order of the database."""

    def add(self, depth_m: Float[Tensor, "H W"]) -> None:
        """Add the depth of the keyframe last added to ``database``."""
        self.thumbnails.append(depth_thumbnail(depth_m))

    def loops(self, row: int) -> Iterator[tuple[int, RelativePose]]:
        """Earlier keyframes that see the same place as keyframe ``row``, each with the relative pose."""
        for earlier in self._candidates(row):
            pose = self._pose(row, earlier)
            if pose is not None and self._is_true(row, earlier, pose):
                yield earlier, pose

    def _candidates(self, row: int) -> list[int]:
        before = row - self.config.loop_min_gap
        if before < 0:
            return []
        rows = [r for r, _ in self.database.similar(self.database.features[row], CANDIDATES, exclude_after=before + 1)]
        near = self.database.nearest_view(self.database.T_WC[row], before + 1)
        return rows if near in rows else [*rows, near]

    def _pose(self, row: int, earlier: int) -> RelativePose | None:
        """Pose of one keyframe relative to another: from their features, then from all landmarks around the other."""
        features, camera = self.database.features[row], self.database.camera
        pose = self.database.compare(features, earlier)
        if pose is None or len(pose.rows) < self.config.loop_min_inliers:
            return None
        T_WR = self.database.T_WC[earlier]
        around = list(range(max(0, earlier - AROUND), min(earlier + AROUND, row - self.config.loop_min_gap) + 1))
        pairs = self.landmarks.find(features, T_WR @ pose.T_RQ, around, SEARCH_SHARE / 4 * camera.width)
        return refine_pose(camera, self.landmarks.points(features, pairs, T_WR), pose.T_RQ, pairs)

    def _is_true(self, row: int, earlier: int, pose: RelativePose) -> bool:
        thumbnails = (self.thumbnails[row], self.thumbnails[earlier])
        features, camera = self.database.features[row], self.database.camera
        reason = why_not_same_place(pose, features, thumbnails, camera, self.config.loop_min_inliers)
        poses = self.database.T_WC
        drift = se3.inverse(pose.T_RQ) @ se3.inverse(poses[earlier]) @ poses[row]
        path = path_between(torch.stack(poses[earlier : row + 1]))
        if not reason and not path.allows(drift, self.config.loop_max_drift):
            reason = f"the trajectory cannot have drifted by {float(drift[:3, 3].norm()):.2f} m"
        if reason:
            log.debug("no loop from keyframe %d to %d: %s", row, earlier, reason)
        return not reason
