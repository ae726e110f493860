"""3D points seen by several keyframes, found again by projection and Hamming distance (Peng et al.
2024, sec. 3.2)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from ..geometry import se3
from .features import Features
from .keyframe_database import KeyframeDatabase
from .landmark_pose import LandmarkRows, inverse_or_zero
from .matching import found_near

NO_LANDMARK = -1

CULL_VIEWS = 15
CULL_SHARE = 0.05
"""A landmark that at least this many frames should have seen, and less than this share of them
found, is no longer searched for: it is hidden, moved, or does not look the same from elsewhere."""

SEARCH_SHARE = 0.05
"""Radius of the first search for a landmark around its predicted pixel, as a share of the image
width; the second search, with the pose estimated from the first, uses a quarter of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Observations of landmarks by keyframes, one row each."""

    keyframe: Int[Tensor, " O"]
    landmark: Int[Tensor, " O"]
    """Number of the landmark, 0..L-1 in this table."""
    uv: Float[Tensor, "O 2"]
    depth_m: Float[Tensor, " O"]
    """Metres; 0 where not measured."""
    sigma_px: Float[Tensor, " O"]
    xyz_W: Float[Tensor, "L 3"]
    """Position of every landmark of the table, world frame, metres."""
    name: Int[Tensor, " L"]
    """Its number among all landmarks."""

    def __len__(self) -> int:
        return self.keyframe.shape[0]


class Landmarks:
    """Tracks of features over the keyframes of ``database``.

    Every feature with depth that matches no known landmark becomes a new one. Its position is
    stored in the camera frame of its first keyframe, so that it moves with a correction of that
    keyframe's pose. At first it is the one that the keyframe measured; an adjustment improves it
    (``refine``).
    """

    def __init__(self, database: KeyframeDatabase):
        self.database = database
        self.of_feature: list[ndarray] = []
        """Landmark of every feature of every keyframe; -1 for none. [M] each"""
        self._birth = np.zeros((0, 2), np.int32)
        self._xyz_B = np.zeros((0, 3))
        """Position in the camera frame of the first keyframe, metres. [L, 3]"""
        self._views = np.zeros((0, 2), np.int32)
        """Number of frames that should have seen the landmark, and of those that found it. [L,
        2]"""

    def __len__(self) -> int:
        return len(self._birth)

    def find(
        self,
        features: Features,
        T_WC: Float[Tensor, "4 4"],
        rows: list[int],
        radius_px: float,
    ) -> Int[Tensor, "P 2"]:
        """Landmarks seen from the keyframes ``rows`` that project near a feature with a similar
        descriptor.

        Both of a pair are each other's nearest descriptor within ``radius_px``, they differ in at
        most 64 bits, and clearly less than the landmark's second best match.

        Returns:
            (feature row, landmark). [P, 2]
        """
        landmark, descriptors = self.seen_from(rows)
        xyz_W = self.positions(torch.from_numpy(landmark)).numpy()
        pairs = found_near(self.database.camera, xyz_W, descriptors, features, T_WC, radius_px)
        row, at = pairs.T
        return torch.from_numpy(np.stack([row, landmark[at]], 1))

    def add(self, features: Features, pairs: Int[Tensor, "P 2"]) -> None:
        """Process the keyframe last added to ``database``: known landmarks by ``pairs``, new ones
        for the rest."""
        row = len(self.of_feature)
        of_feature = np.full(len(features), NO_LANDMARK, np.int32)
        of_feature[pairs[:, 0].numpy()] = pairs[:, 1].numpy()
        new = ((of_feature == NO_LANDMARK) & features.has_depth.numpy()).nonzero()[0]
        of_feature[new] = len(self) + np.arange(len(new))
        self.of_feature.append(of_feature)
        birth = np.stack([np.full_like(new, row), new], 1).astype(np.int32)
        xyz_B = features.xyz_C.numpy()[new].astype(np.float64)
        no_views = np.zeros((len(new), 2), np.int32)
        self._birth = np.concatenate([self._birth, birth])
        self._xyz_B = np.concatenate([self._xyz_B, xyz_B])
        self._views = np.concatenate([self._views, no_views])

    def count_views(self, expected: ndarray, found: ndarray) -> None:
        """Count a frame that should have seen the landmarks ``expected`` and found ``found`` of
        them."""
        self._views[expected, 0] += 1
        self._views[found, 1] += 1

    def is_good(self, landmark: ndarray) -> ndarray:
        """Whether each landmark is worth a search: it has not been looked for in vain too often."""
        n_expected, n_found = self._views[landmark].T
        return (n_expected < CULL_VIEWS) | (n_found >= CULL_SHARE * n_expected)

    def refine(
        self,
        landmark: Int[Tensor, " N"],
        xyz_W: Float[Tensor, "N 3"],
    ) -> None:
        """Replace the positions of some landmarks, world frame, with the keyframes' present poses.
        What is not finite is left out."""
        is_known = torch.isfinite(xyz_W).all(1).numpy()
        number = landmark.numpy()[is_known]
        at_W = xyz_W.double().numpy()[is_known]
        T = self._poses()[self._birth[number, 0]]
        from_camera = at_W - T[:, :3, 3]
        self._xyz_B[number] = np.einsum("nji,nj->ni", T[:, :3, :3], from_camera)

    def fuse(self, same: list[tuple[int, Tensor]]) -> None:
        """Make one landmark, the oldest, of those that loops say are the same.

        Args:
            same: Of each loop a keyframe, and which feature of it shows which landmark, pairs
                [I, 2].
        """
        if not same:
            return
        group = self._groups(same)
        oldest = np.unique(group, return_index=True)[1].astype(np.int32)  # by group
        for row, landmark in enumerate(self.of_feature):
            fused_landmark = np.where(landmark >= 0, oldest[group[landmark]], NO_LANDMARK)
            # two features of one keyframe would be a wrong match
            first_rows = np.unique(fused_landmark, return_index=True)[1]
            self.of_feature[row] = np.full_like(landmark, NO_LANDMARK)
            self.of_feature[row][first_rows] = fused_landmark[first_rows]

    def positions(self, landmark: Int[Tensor, " N"]) -> Float[Tensor, "N 3"]:
        """World positions, float64, metres."""
        number = landmark.numpy()
        if len(number) == 0:
            return torch.zeros((0, 3), dtype=torch.float64)
        T = self._poses()[self._birth[number, 0]]
        offset_W = np.einsum(
            "nij,nj->ni",
            T[:, :3, :3],
            self._xyz_B[number],
        )
        return torch.from_numpy(offset_W + T[:, :3, 3])

    def _poses(self) -> ndarray:
        return torch.stack(self.database.T_WC).numpy()

    def rows(
        self, features: Features, pairs: Int[Tensor, "P 2"], T_WR: Float[Tensor, "4 4"]
    ) -> LandmarkRows:
        """The ``pairs`` from ``find``: points in a reference camera frame R, where the features
        show them."""
        matched_features = features[pairs[:, 0]]
        return LandmarkRows(
            camera=self.database.camera,
            xyz_W=se3.apply(se3.inverse(T_WR), self.positions(pairs[:, 1])).numpy(),
            uv=matched_features.uv.double().numpy(),
            inverse_depth=inverse_or_zero(matched_features.xyz_C[:, 2].double().numpy()),
            sigma_px=matched_features.sigma_px.double().numpy()
            * 2**0.5,  # the landmark's own pixel had the same error
        )

    def shared(self, row_a: int, row_b: int) -> Int[Tensor, "P 2"]:
        """Features of two keyframes that are the same landmark and have depth in b: (feature of a,
        feature of b)."""
        a = self.of_feature[row_a]
        b = self.of_feature[row_b]
        common, at_a, at_b = np.intersect1d(a, b, return_indices=True)
        at_a = at_a[common >= 0]
        at_b = at_b[common >= 0]
        with_depth = self.database.features[row_b].has_depth.numpy()[at_b]
        pairs = np.stack([at_a, at_b], 1)[with_depth]
        return torch.from_numpy(pairs.astype(np.int64))

    def observations(
        self, *, per_keyframe: int, keyframes: list[int] | None = None
    ) -> Observations:
        """Observations of landmarks that at least two keyframes see, reduced to ``per_keyframe`` of
        each.

        Args:
            per_keyframe: About this many landmarks of each keyframe are used, those with the
                longest tracks.
            keyframes: Rows of the keyframes whose observations count; all by default.
        """
        rows = list(range(len(self.of_feature))) if keyframes is None else keyframes
        views = [self.database.features[r] for r in rows]
        row = np.repeat(np.array(rows, int), [len(f) for f in views])
        tracks = [self.of_feature[r] for r in rows]
        landmark = np.concatenate([np.zeros(0, np.int64), *tracks]).astype(np.int64)
        feature_rows = (landmark >= 0).nonzero()[0]
        name = landmark[feature_rows]
        # One observation per keyframe and landmark; two would be a wrong match.
        by_keyframe = name * (len(self.of_feature) + 1) + row[feature_rows]
        _, first = np.unique(by_keyframe, return_index=True)
        sighting = feature_rows[first]
        name = name[first]
        length = np.bincount(name, minlength=len(self))[name]
        order = np.lexsort((-length, row[sighting]))
        place = np.arange(len(order))
        begins = np.diff(row[sighting][order], prepend=-1) != 0
        start = np.maximum.accumulate(np.where(begins, place, 0))
        is_chosen = (place - start < per_keyframe) & (length[order] >= 2)
        is_observed = np.isin(name, name[order][is_chosen])
        sighting = sighting[is_observed]
        name = name[is_observed]
        _, born, number = np.unique(name, return_index=True, return_inverse=True)
        at = torch.from_numpy(sighting)
        nothing = torch.zeros((0, 3))
        xyz_C = torch.cat([nothing, *(f.xyz_C for f in views)])
        uv = torch.cat([nothing[:, :2], *(f.uv for f in views)])
        sigma_px = torch.cat([nothing[:, 0], *(f.sigma_px for f in views)])
        return Observations(
            keyframe=torch.from_numpy(row[sighting].astype(np.int64)),
            landmark=torch.from_numpy(number.astype(np.int64)),
            uv=uv[at].double(),
            depth_m=xyz_C[at, 2].double(),
            sigma_px=sigma_px[at].double(),
            xyz_W=self.positions(torch.from_numpy(name[born])),
            name=torch.from_numpy(name[born]),
        )

    def state_dict(self) -> dict[str, Any]:
        """What ``load_state`` needs, as tensors."""
        return {
            "of_feature": [torch.from_numpy(f) for f in self.of_feature],
            "birth": torch.from_numpy(self._birth),
            "xyz_B": torch.from_numpy(self._xyz_B),
            "views": torch.from_numpy(self._views.copy()),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace the tracks by those of ``state_dict``; ``database`` must hold their keyframes."""
        self.of_feature = [f.cpu().numpy() for f in state["of_feature"]]
        self._birth = state["birth"].cpu().numpy()
        self._xyz_B = state["xyz_B"].cpu().numpy().copy()
        self._views = state["views"].cpu().numpy().copy()

    def seen_from(self, rows: list[int]) -> tuple[ndarray, ndarray]:
        """Landmarks seen from the keyframes, each with the descriptor of its latest observation."""
        landmark = [np.zeros(0, np.int64)]
        descriptors = [np.zeros((0, 32), np.uint8)]
        for r in sorted(rows, reverse=True):
            has_landmark = self.of_feature[r] >= 0
            landmark.append(self.of_feature[r][has_landmark].astype(np.int64))
            descriptors.append(self.database.features[r].descriptors.numpy()[has_landmark])
        every, latest = np.unique(np.concatenate(landmark), return_index=True)
        return every, np.concatenate(descriptors)[latest]

    def _groups(self, same: list[tuple[int, Tensor]]) -> ndarray:
        """Number of the group of each landmark; landmarks that loops identify are one group. [L]"""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        pairs = [np.zeros((0, 2), np.int32)]
        for row, of_loop in same:
            feature, landmark = of_loop.numpy().T
            pairs.append(np.stack([self.of_feature[row][feature], landmark], 1))
        link_pairs = np.concatenate(pairs)
        link_pairs = link_pairs[(link_pairs >= 0).all(1)]
        links = coo_matrix(
            (np.ones(len(link_pairs)), link_pairs.T),
            shape=(len(self), len(self)),
        )
        return connected_components(links, directed=False)[1].astype(np.int64)
