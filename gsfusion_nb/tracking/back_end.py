"""The back end of tracking: keyframes, landmarks, loops, and the pose graph that makes them
consistent.

Peng et al. 2024, section 3.2: "a back-end optimization thread similar to ORB-SLAM2 ... a set of 3D
landmarks are also maintained ... used for graph optimization". Here it runs in turn with the front
end, keyframe by keyframe, with ORB features (OpenCV) and a pose graph.

``LoopFinder`` finds earlier keyframes that show the same place as a new one, and checks that they
do. A ``Correction`` holds the poses of keyframes before and after; everything else moves with them.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_pose
from ..geometry import se3
from ..types import Camera, Frame
from .bundle_adjustment import adjust
from .correction import Correction
from .edges import Edge, edge_error, fit_odometry, odometry_information, with_floor
from .features import FEATURES, LEVELS, Features
from .landmark_map import LandmarkMap
from .loop_finder import LoopFinder
from .matching import RelativePose, refine_pose, rows_of
from .pose_graph import optimise_poses

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
