"""Loops: earlier keyframes that see the same place as a new one."""

import logging
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import backproject, pixel_grid, project, se3
from ..types import Camera
from .features import Features
from .keyframe_database import KeyframeDatabase
from .landmarks import SEARCH_SHARE, Landmarks
from .matching import RelativePose, refine_pose

log = logging.getLogger(__name__)

THUMBNAIL_PX = 64
"""Width of the small depth image that is stored for each keyframe, pixels."""

MIN_SHARE = 0.3
"""At least this share of the matches must agree on the pose."""

MIN_CELLS = 4
"""The agreeing features must lie in at least this many cells of a 4 x 4 grid over the image, not
all on one poster."""

DEPTH_TOLERANCE = (0.05, 0.03)
"""Depths of one surface differ by less than 5 cm plus 3 %: noise, slopes between samples, pose
errors of 1 degree."""

MIN_DEPTH_AGREEMENT = 0.7
"""At least this share of the pixels that are not hidden must show the same surface in both
views."""

MIN_DEPTH_PIXELS = 20
"""With fewer overlapping pixels the depth is not used to reject a loop."""

DRIFT_M = 0.3

DRIFT_DEG = 10.0

DRIFT_SHARE = 0.2
"""A loop may disagree with the trajectory by this much, plus this share of the path in between:
otherwise it is another place that looks the same."""

MIN_GAP = 8
"""A loop connects keyframes that are at least this many keyframes apart."""

MIN_INLIERS = 30
"""Smallest number of landmarks that must agree on the relative pose of a loop."""


def may_drift(drift: Float[Tensor, "4 4"], T_WC: Float[Tensor, "K 4 4"]) -> bool:
    """Whether a drift is plausible along these poses: at most 0.3 m and 10 degrees plus a fifth of
    the path."""
    steps = se3.inverse(T_WC[:-1]) @ T_WC[1:]
    path_m = float(steps[:, :3, 3].norm(dim=1).sum())
    path_deg = float(torch.rad2deg(se3.rotation_angle(steps[:, :3, :3]).sum()))
    metres = float(drift[:3, 3].norm())
    degrees = float(torch.rad2deg(se3.rotation_angle(drift[:3, :3])))
    plausible_m = metres <= DRIFT_M + DRIFT_SHARE * path_m
    return plausible_m and degrees <= DRIFT_DEG + DRIFT_SHARE * path_deg


def why_not_same_place(
    pose: RelativePose, features: Features, thumbnails: tuple[Tensor, Tensor], camera: Camera
) -> str:
    """The reason why two views cannot show the same place; empty if there is none.

    Args:
        pose: Query relative to reference; the first column of its rows are features of the query.
        features: Features of the query.
        thumbnails: Small depth images of query and reference, from ``depth_thumbnail``.
        camera: Intrinsics of the full images.
    """
    agreeing = len(pose.rows)
    if agreeing < max(MIN_INLIERS, MIN_SHARE * pose.n_matches):
        return f"{agreeing} of {pose.n_matches} matches agree"
    size = torch.tensor([camera.width, camera.height])
    cells = (features.uv[pose.rows[:, 0]] / size * 4).long()
    n_cells = len(torch.unique(cells[:, 0] + 4 * cells[:, 1]))
    if n_cells < MIN_CELLS:
        return f"all matches lie in {n_cells} of 16 parts of the image"
    query, reference = thumbnails
    forward_pair = (query, reference, pose.T_RQ)
    backward_pair = (reference, query, se3.inverse(pose.T_RQ))
    for a, b, T_BA in (forward_pair, backward_pair):
        share, pixels = depth_agreement(camera, a, b, T_BA)
        if pixels >= MIN_DEPTH_PIXELS and share < MIN_DEPTH_AGREEMENT:
            return f"the depths agree at {share:.0%} of the pixels"
    return ""


def depth_thumbnail(depth_m: Float[Tensor, "H W"]) -> Float[Tensor, "h w"]:
    """A depth image about 64 pixels wide; each pixel is the depth in the middle of its cell,
    metres."""
    step = max(1, depth_m.shape[1] // THUMBNAIL_PX)
    return depth_m[step // 2 :: step, step // 2 :: step].cpu().clone()


def depth_agreement(
    camera: Camera,
    depth_a: Float[Tensor, "h w"],
    depth_b: Float[Tensor, "h w"],
    T_BA: Float[Tensor, "4 4"],
) -> tuple[float, int]:
    """Share of a's pixels whose point lies on b's surface, among those that lie on it or in front
    of it.

    Points behind b's surface are hidden and are not counted, unless they are the majority.

    Returns:
        Share, and the number of pixels that were counted.
    """
    height, width = depth_a.shape
    small = camera.resized(width, height)
    has_depth = depth_a > 0
    uv_A = pixel_grid(small)[has_depth]
    xyz_A = backproject(small, uv_A, depth_a[has_depth]).double()
    xyz_B = se3.apply(T_BA, xyz_A)
    xyz_B = xyz_B[xyz_B[:, 2] > 0.1]
    uv = project(small, xyz_B)
    column, row = uv.floor().long().unbind(1)
    in_width = (column >= 0) & (column < width)
    in_height = (row >= 0) & (row < height)
    in_image = in_width & in_height
    z = xyz_B[in_image, 2]
    z_seen = depth_b[row[in_image], column[in_image]].double()
    z = z[z_seen > 0]
    z_seen = z_seen[z_seen > 0]
    tolerance = DEPTH_TOLERANCE[0] + DEPTH_TOLERANCE[1] * z_seen
    agree = int(((z - z_seen).abs() <= tolerance).sum())
    contradict = int((z < z_seen - tolerance).sum())
    n_hidden = len(z) - agree - contradict
    n_counted = agree + contradict + max(0, n_hidden - agree - contradict)
    return agree / max(n_counted, 1), n_counted


CANDIDATES = 3
"""Loops are searched in this many of the most similar keyframes and in the one whose pose is
nearest."""

AROUND = 2
"""A loop uses the landmarks of this many keyframes before and after the earlier keyframe."""


class LoopFinder:
    """Finds loops from the keyframes of ``database``, by appearance, landmarks and depth."""

    def __init__(self, database: KeyframeDatabase, landmarks: Landmarks):
        self.database = database
        self.landmarks = landmarks
        self.thumbnails: list[Tensor] = []
        """Small depth images of the keyframes, in the order of the database."""

    def add(self, depth_m: Float[Tensor, "H W"]) -> None:
        """Add the depth of the keyframe last added to ``database``."""
        self.thumbnails.append(depth_thumbnail(depth_m))

    def loops(self, row: int) -> Iterator[tuple[int, RelativePose]]:
        """Earlier keyframes that see the same place as keyframe ``row``, each with the relative
        pose."""
        for earlier in self._candidates(row):
            pose = self._pose(row, earlier)
            if pose is not None and self._is_true(row, earlier, pose):
                yield earlier, pose

    def _candidates(self, row: int) -> list[int]:
        last_row = row - MIN_GAP
        if last_row < 0:
            return []
        rows = [
            r
            for r, _ in self.database.similar(
                self.database.features[row], CANDIDATES, exclude_after=last_row + 1
            )
        ]
        nearest_row = self.database.nearest_view(self.database.T_WC[row], last_row + 1)
        return rows if nearest_row in rows else [*rows, nearest_row]

    def _pose(self, row: int, earlier: int) -> RelativePose | None:
        """Pose of one keyframe relative to another: from their features, then from all landmarks
        around the other."""
        features = self.database.features[row]
        camera = self.database.camera
        pose = self.database.compare(features, earlier)
        if pose is None or len(pose.rows) < MIN_INLIERS:
            return None
        T_WR = self.database.T_WC[earlier]
        first = max(0, earlier - AROUND)
        last = min(earlier + AROUND, row - MIN_GAP)
        rows = list(range(first, last + 1))
        pairs = self.landmarks.find(
            features, T_WR @ pose.T_RQ, rows, SEARCH_SHARE / 4 * camera.width
        )
        return refine_pose(self.landmarks.rows(features, pairs, T_WR), pose.T_RQ, pairs)

    def _is_true(self, row: int, earlier: int, pose: RelativePose) -> bool:
        thumbnails = (self.thumbnails[row], self.thumbnails[earlier])
        features = self.database.features[row]
        camera = self.database.camera
        reason = why_not_same_place(pose, features, thumbnails, camera)
        poses = self.database.T_WC
        drift = se3.inverse(pose.T_RQ) @ se3.inverse(poses[earlier]) @ poses[row]
        if not reason and not may_drift(drift, torch.stack(poses[earlier : row + 1])):
            reason = f"the trajectory cannot have drifted by {float(drift[:3, 3].norm()):.2f} m"
        if reason:
            log.debug("no loop from keyframe %d to %d: %s", row, earlier, reason)
        return not reason
