"""The back end of tracking: keyframes, landmarks, loops, and the pose graph that makes them
consistent.

Peng et al. 2024, section 3.2: "a back-end optimization thread similar to ORB-SLAM2 ... a set of 3D
landmarks are also maintained ... used for graph optimization". Here it runs in turn with the front
end, keyframe by keyframe, with ORB features (OpenCV) and a pose graph.

``LoopFinder`` finds earlier keyframes that show the same place as a new one, and checks that they
do. A ``Correction`` holds the poses of keyframes before and after; everything else moves with them.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..checks import check_pose
from ..geometry import backproject, pixel_grid, project, se3
from ..geometry.pose_path import pose_between
from ..types import Camera, Frame
from .bundle_adjustment import adjust
from .features import FEATURES, LEVELS, Features
from .keyframe_database import KeyframeDatabase
from .landmark_map import LandmarkMap
from .landmarks import SEARCH_SHARE, Landmarks
from .matching import RelativePose, refine_pose, rows_of
from .pose_graph import (
    Edge,
    edge_error,
    fit_odometry,
    odometry_information,
    optimise_poses,
    with_floor,
)

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """New poses of all keyframes. Gaussians and frames near a keyframe move with it."""

    frame_index: Int[Tensor, " K"]
    """Frame index of each keyframe, increasing."""
    T_WC_old: Float[Tensor, "K 4 4"]
    T_WC_new: Float[Tensor, "K 4 4"]
    """Camera-to-world, float64."""
    loops: list[tuple[int, int, int]]
    """(frame index, earlier frame index, matches that agree) of the loops found since the last
    correction."""

    def transform_of(self, frame_index: Int[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
        """The motion of the world near each frame: T_new T_old^-1, blended between the keyframes
        before and after.

        The point between the two old camera centres moves to the interpolation of its two images
        (``pose_between``, with this point as the pivot).

        Args:
            frame_index: Frames, in any order; before the first and after the last keyframe its
                transform is used. [N]

        Returns:
            World-to-world transforms, float64. Exactly the identity where the keyframes did not
            move.
        """
        keyframe = self.frame_index
        row = torch.searchsorted(keyframe, frame_index.to(keyframe), right=True) - 1
        a = row.clamp_min(0)
        b = (row + 1).clamp_max(len(keyframe) - 1)
        a = torch.where(row < 0, b.clamp_max(0), a)
        b = torch.where(row < 0, a, b)
        gap = (keyframe[b] - keyframe[a]).clamp_min(1)
        n_passed = (frame_index.to(keyframe) - keyframe[a]).double()
        t = (n_passed / gap).clamp(0, 1) * (a != b)
        motion = _motion(self.T_WC_old, self.T_WC_new)
        old_centre = self.T_WC_old[:, :3, 3]
        s = t[:, None]
        pivot = (1 - s) * old_centre[a] + s * old_centre[b]
        return pose_between(motion[a], motion[b], t, pivot=pivot)


def _motion(T_old: Tensor, T_new: Tensor) -> Tensor:
    """T_new T_old^-1; exactly the identity where they are equal."""
    same = (T_old == T_new).flatten(1).all(1)
    eye = torch.eye(4, dtype=torch.float64).expand_as(T_old)
    return torch.where(
        same[:, None, None],
        eye,
        T_new @ se3.inverse(T_old),
    )


TIED_TO = 3
"""A new keyframe gets edges to this many keyframes around it, those with which it shares most
landmarks."""

MIN_SHARED = 15
"""Smallest number of common landmarks for an edge between two keyframes."""

LANDMARK_FLOOR = (0.05, 0.002)
"""Smallest standard deviation of a relative pose from features, degrees and metres."""

LANDMARK_SHARE = 0.25
"""The last adjustment counts the squared errors of landmarks as this share of what they would be
worth if they were independent; a corner is found beside its place in the same way by many views."""

LOOP_MAX_SIGMA = 5.0
"""A loop with a larger error after the optimisation, in standard deviations, is false: its matches
are not used."""


KEYFRAME_DEG = 15.0
KEYFRAME_M = 0.15
"""The graph gets a new keyframe when the camera has turned, or moved, by more than this since the
last one. Larger: a smaller graph, faster, but fewer chances to find a loop."""

CORRECT_FROM_M = 0.02
CORRECT_FROM_DEG = 0.5
"""A loop corrects the trajectory at once if they disagree by more than this; smaller differences
are corrected at the end of the scan."""

ODOMETRY_SIGMA_DEG = 0.5
ODOMETRY_SIGMA_M = 0.02
"""Largest standard deviation of the tracked motion between two keyframes, per axis; it is trusted
more where it agrees with the landmarks (``fit_odometry``)."""

LANDMARKS_PER_KEYFRAME = 150
"""How many landmarks of each keyframe take part in the optimisation at the end, those seen in most
frames first."""


def moved_enough(last: Float[Tensor, "4 4"], T_WC: Float[Tensor, "4 4"]) -> bool:
    """Whether the camera has turned or moved far enough since the pose ``last`` for a new
    keyframe."""
    turned_deg, moved_m = se3.motion(last, T_WC)
    return turned_deg > KEYFRAME_DEG or moved_m > KEYFRAME_M


class BackEnd:
    """Corrects the front end's trajectory over keyframes.

    World frame: ``add`` expects poses in the world frame as corrected so far; a front end applies
    each ``Correction`` to its own pose before the next frame.
    """

    def __init__(self, camera: Camera, *, features: int = FEATURES, levels: int = LEVELS):
        """
        Args:
            camera: Intrinsics of all frames.
            features, levels: ORB features of a keyframe and levels of their pyramid
                (``extract_features``).
        """
        self.camera = camera
        self.map = LandmarkMap(camera, count=features, levels=levels)
        """Keyframes and landmarks; the front end uses it, too."""
        self.database = self.map.database
        self.landmarks = self.map.landmarks
        self._finder = LoopFinder(self.database, self.landmarks)
        self.edges: list[Edge] = []
        self.loops: list[tuple[int, Tensor]] = []
        """(keyframe row, pairs of feature and landmark [I, 2]) of each loop, in the order of the
        edges of that kind."""
        self._fresh_loops: list[tuple[int, int, int]] = []

    def __len__(self) -> int:
        return len(self.database)

    @property
    def T_WC(self) -> Float[Tensor, "K 4 4"]:
        """Current poses of the keyframes, camera-to-world, float64."""
        return (
            torch.stack(self.database.T_WC)
            if len(self)
            else torch.zeros((0, 4, 4), dtype=torch.float64)
        )

    def wants(self, T_WC: Float[Tensor, "4 4"]) -> bool:
        """Whether the camera has moved or turned enough since the last keyframe to become one."""
        return not len(self) or moved_enough(self.database.T_WC[-1], T_WC)

    def add(
        self, frame: Frame, T_WC: Float[Tensor, "4 4"], features: Features | None = None
    ) -> Correction | None:
        """Add a keyframe; if it closes a loop that the trajectory does not, optimise the poses.

        Args:
            frame: Colour and depth, later than those before; its own pose is not used.
            T_WC: The front end's pose, in the world as corrected so far. [4, 4]
            features: Those of the frame, if they were extracted before.

        Returns:
            The correction, or None if there is none.

        Raises:
            ValueError: a pose that is not rigid.
        """
        check_pose("T_WC", T_WC)
        T_WC = se3.rigid(T_WC.detach().cpu().double())
        if features is None:
            features = self.database.extract(frame)
        row = len(self)
        nearby_rows, sighting = self.map.add(frame.index, T_WC, features)
        self._finder.add(frame.depth_m)
        self._tie(row, nearby_rows, T_WC if sighting is None else sighting.T_WC)
        return self._correct(landmarks=False) if self._close_loops(row) else None

    def finish(self) -> Correction | None:
        """Optimise all poses and landmarks together, once; None with fewer than two keyframes."""
        return self._correct(landmarks=True) if len(self) > 1 else None

    def _tie(self, row: int, nearby_rows: list[int], T_seen: Tensor) -> None:
        """Add edges to the previous keyframe (odometry) and to those with most common landmarks,
        which give the keyframe the pose ``T_seen``."""
        if not nearby_rows:
            return
        T = self.database.T_WC
        information = odometry_information(ODOMETRY_SIGMA_DEG, ODOMETRY_SIGMA_M)
        step = se3.inverse(T[row - 1]) @ T[row]
        self.edges.append(
            Edge(i=row - 1, j=row, T_ij=step, information=information, kind="odometry")
        )
        pairs = {r: self.landmarks.shared(row, r) for r in nearby_rows}
        for r in sorted(nearby_rows, key=lambda r: -len(pairs[r]))[:TIED_TO]:
            if len(pairs[r]) < MIN_SHARED:
                continue
            rows = rows_of(
                self.camera,
                self.database.features[row],
                self.database.features[r],
                pairs[r],
            )
            pose = refine_pose(rows, se3.inverse(T[r]) @ T_seen, pairs[r])
            if pose is not None and len(pose.rows) >= MIN_SHARED:
                self.edges.append(self._edge(r, row, pose, "landmarks"))

    def _edge(self, i: int, j: int, pose: RelativePose, kind: Any) -> Edge:
        return Edge(
            i=i,
            j=j,
            T_ij=pose.T_RQ,
            information=with_floor(pose.information, *LANDMARK_FLOOR),
            kind=kind,
        )

    def _close_loops(self, row: int) -> bool:
        """Add the loops that the new keyframe closes. Returns whether the trajectory contradicts
        one of them."""
        is_off = False
        for earlier, pose in self._finder.loops(row):
            edge = self._edge(earlier, row, pose, "loop")
            self.edges.append(edge)
            self.loops.append((row, pose.rows))
            self._fresh_loops.append(
                (self.database.index[row], self.database.index[earlier], len(pose.rows))
            )
            T_gap = (
                se3.inverse(pose.T_RQ)
                @ se3.inverse(self.database.T_WC[earlier])
                @ self.database.T_WC[row]
            )
            degrees = float(torch.rad2deg(se3.rotation_angle(T_gap[:3, :3])))
            is_off |= float(T_gap[:3, 3].norm()) > CORRECT_FROM_M or degrees > CORRECT_FROM_DEG
        return is_off

    def _correct(self, *, landmarks: bool) -> Correction:
        """Optimise the poses with relative poses and then, with ``landmarks``, also with the
        landmarks. Landmarks that loops show to be the same become one."""
        old = self.T_WC
        self.map.move(optimise_poses(old, fit_odometry(self.edges)).T_WC)
        self.landmarks.fuse(self._true_loops())
        if landmarks:
            self._with_landmarks()
        self.map.collect()
        fresh = self._fresh_loops
        self._fresh_loops = []
        return Correction(
            frame_index=torch.tensor(self.database.index),
            T_WC_old=old,
            T_WC_new=self.T_WC,
            loops=fresh,
        )

    def _true_loops(self) -> list[tuple[int, Tensor]]:
        """The loops that the present poses agree with."""
        loops = [e for e in self.edges if e.kind == "loop"]
        T_WC = self.T_WC
        return [
            loop
            for loop, e in zip(self.loops, loops, strict=True)
            if edge_error(e, T_WC) < LOOP_MAX_SIGMA
        ]

    def _with_landmarks(self) -> None:
        """Adjust all poses but the first, and the landmarks, which keep what was found."""
        observations = self.landmarks.observations(per_keyframe=LANDMARKS_PER_KEYFRAME)
        steps = [e for e in fit_odometry(self.edges) if e.kind == "odometry"]
        odometry = [replace(e, information=e.information / LANDMARK_SHARE) for e in steps]
        adjustment = adjust(
            self.camera,
            self.T_WC,
            observations,
            odometry,
            torch.arange(len(self)) == 0,
            iterations=20,
        )
        self.map.move(adjustment.T_WC)
        self.landmarks.refine(observations.name, adjustment.xyz_W)

    def state_dict(self) -> dict[str, Any]:
        """Everything except the settings: numbers, lists and tensors."""
        return {
            "map": self.map.state_dict(),
            "edges": [dict(vars(e)) for e in self.edges],
            "loops": list(self.loops),
            "fresh_loops": list(self._fresh_loops),
            "thumbnails": list(self._finder.thumbnails),
        }

    @classmethod
    def from_state_dict(cls, camera: Camera, state: dict[str, Any]) -> "BackEnd":
        """The back end that was saved with ``state_dict``."""
        self = cls(camera)
        self.map.load_state(state["map"])
        self.edges = [Edge(**e) for e in state["edges"]]
        self.loops = [(row, pairs) for row, pairs in state["loops"]]
        self._fresh_loops = [(a, b, n) for a, b, n in state["fresh_loops"]]
        self._finder.thumbnails = list(state["thumbnails"])
        return self
