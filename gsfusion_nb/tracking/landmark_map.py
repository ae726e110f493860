"""Keyframes and landmarks together: which of them a new view can see, and the camera's pose that
they give."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..types import Camera
from .bundle_adjustment import adjust
from .features import FEATURES, LEVELS, Features
from .icp import ExtraRows
from .keyframe_database import KeyframeDatabase
from .landmark_pose import LandmarkRows, inverse_or_zero, landmark_pose, landmark_sums
from .landmarks import SEARCH_SHARE, Landmarks
from .matching import found_near, in_view

LATEST = 3
"""The local map has the landmarks of this many keyframes, the last ones, ..."""

COVISIBLE = 7
"""... and of this many others, those that share most landmarks with the last one, ..."""

LEAST_SHARED = 15
"""... if they share at least this many; and of the earlier keyframe whose pose is nearest."""

SEARCHES = (SEARCH_SHARE, SEARCH_SHARE / 2, SEARCH_SHARE / 4)
"""Radius of one search after the other, as a share of the image width; the first is left out where
the prediction is good."""

LEAST_SEEN = 20
"""A view needs this many landmarks that agree with its pose."""

LEAST_SHARE = 0.4
"""At least this share of the matches must agree."""


SIGMA_M = 0.02
"""A landmark that is off by one standard deviation counts in ICP as much as a pixel of near depth
that is off by this, metres, where depth contradicts the landmarks beyond their noise. Larger:
texture counts more, depth less."""

ALLOWED = 6.0
"""The mean of a chi-squared distribution with 6 degrees of freedom. With its 95 % quantile, 12.6,
the error on 50 frames of a real recording was 0.75 cm instead of 0.63; in a room with simulated
noise it was that of depth alone."""

MOST_REFINED = 1000
REFINING_STEPS = 3
"""At most this many landmarks of each keyframe are refined with every new keyframe, in this many
steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """Landmarks that were found in a view, and the pose that they give."""

    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world, float64."""
    rows: LandmarkRows
    """The landmarks that agree with that pose."""
    pairs: Int[ndarray, "P 2"]
    """(feature, landmark) of each of these rows."""
    expected: Int[ndarray, " E"]
    """Landmarks that lie in the view at that pose."""

    @property
    def extra(self) -> ExtraRows:
        """The rows for ICP, which count only as far as its pose contradicts them.

        At the true pose the sum of squared errors is larger than at the landmarks' own pose, its
        minimum, by d, which has a chi-squared distribution with 6 degrees of freedom. The factor
        1 - 6 / d is 0 up to its mean: depth with little noise is more exact than landmarks, and
        then decides alone. (The discrepancy principle, Morozov 1966.)
        """
        least = landmark_sums(self.rows, self.T_WC).cost

        def sums(T_WC: Tensor) -> tuple[Tensor, Tensor]:
            landmark_terms = landmark_sums(self.rows, T_WC)
            share = SIGMA_M**2 * (1 - ALLOWED / max(landmark_terms.cost - least, ALLOWED))
            return share * landmark_terms.H, share * landmark_terms.b

        return sums


@dataclass(frozen=True, kw_only=True, eq=False)
class _Local:
    """The landmarks of the local map, with the descriptors of their latest observations."""

    keyframes: list[int]
    landmark: Int[ndarray, " N"]
    xyz_W: Float[ndarray, "N 3"]
    descriptors: ndarray
    around: int = -1
    """Keyframe around which it was chosen; -1: the last one."""

    def part(self, rows: Bool[ndarray, " N"]) -> "_Local":
        """Some of the landmarks."""
        return dataclasses.replace(
            self,
            landmark=self.landmark[rows],
            xyz_W=self.xyz_W[rows],
            descriptors=self.descriptors[rows],
        )


class LandmarkMap:
    """The keyframes (``database``) and landmarks of a run.

    Args:
        camera: Intrinsics of all views.
        count, levels: Features of a view: see ``extract_features``.
    """

    def __init__(self, camera: Camera, *, count: int = FEATURES, levels: int = LEVELS):
        self.camera = camera
        self.database = KeyframeDatabase(camera, count=count, levels=levels)
        self.landmarks = Landmarks(self.database)
        self._local: _Local | None = None

    def __len__(self) -> int:
        return len(self.database)

    def add(
        self, index: int, T_WC: Float[Tensor, "4 4"], features: Features
    ) -> tuple[list[int], Sighting | None]:
        """Add a keyframe: landmarks that are seen again, and new ones.

        Returns:
            The earlier keyframes that it may share landmarks with, and the landmarks that it sees
            again.
        """
        nearby_rows = self.around(T_WC)
        sighting = (
            self._sighting(features, T_WC, self._seen_from(nearby_rows)) if nearby_rows else None
        )
        pairs = np.zeros((0, 2), np.int64) if sighting is None else sighting.pairs
        self.database.add(index, T_WC, features)
        self.landmarks.add(features, torch.from_numpy(pairs))
        self.refine([*nearby_rows, len(self) - 1])
        self.collect()
        return nearby_rows, sighting

    def refine(self, keyframes: list[int]) -> None:
        """Move the landmarks that several of these keyframes see to where they agree best, with the
        poses as they are."""
        observations = self.landmarks.observations(per_keyframe=MOST_REFINED, keyframes=keyframes)
        if len(observations):
            is_fixed = torch.ones(len(self), dtype=torch.bool)
            adjustment = adjust(
                self.camera,
                torch.stack(self.database.T_WC),
                observations,
                [],
                is_fixed,
                iterations=REFINING_STEPS,
            )
            self.landmarks.refine(observations.name, adjustment.xyz_W)

    def collect(self) -> None:
        """Choose the landmarks of the local map: those around the last keyframe that are worth a
        search."""
        self._local = None
        if len(self):
            local = self._seen_from(self.around(self.database.T_WC[-1]))
            self._local = local.part(self.landmarks.is_good(local.landmark))

    def collect_around(self, T_WC: Float[Tensor, "4 4"]) -> None:
        """Choose the landmarks of the local map for a view near a pose, in a map that does not
        grow: those of the nearest keyframe and of the others that see them."""
        if not len(self):
            return
        nearest = self.database.nearest_view(T_WC)
        if self._local is not None and self._local.around == nearest:
            return
        keyframes = sorted({nearest, *self._covisible(nearest, len(self))})
        self._local = dataclasses.replace(self._seen_from(keyframes), around=nearest)

    def see(self, features: Features, T_WC: Float[Tensor, "4 4"]) -> Sighting | None:
        """The landmarks of the local map in a view, and its pose.

        They are searched where ``T_WC``, a prediction, puts them. If too few agree there, the view
        is matched with the keyframe of the local map, which needs no prediction.

        Returns:
            None if fewer than 20 landmarks, or 40 % of the matches, agree with a pose.
        """
        if self._local is None or not len(features):
            return None
        return self._sighting(features, T_WC, self._local)

    def _sighting(self, features: Features, T_WC: Tensor, local: "_Local") -> Sighting | None:
        sighting = self.find(features, T_WC, local) or self.find(features, T_WC, local, SEARCHES)
        if sighting is None:
            pose = self.database.compare(features, local.around)
            sighting = pose and self.find(
                features,
                self.database.T_WC[local.around] @ pose.T_RQ,
                local,
            )
        return sighting

    def count(self, seen: Sighting) -> None:
        """Count a view for the worth of its landmarks (``Landmarks.is_good``)."""
        self.landmarks.count_views(seen.expected, seen.pairs[:, 1])

    def move(self, T_WC: Float[Tensor, "K 4 4"]) -> None:
        """Give the keyframes other poses; landmarks move with them."""
        self.database.move(T_WC)
        self.collect()

    def around(self, T_WC: Float[Tensor, "4 4"]) -> list[int]:
        """Rows of the keyframes whose landmarks a view near the pose ``T_WC`` may see
        (covisibility)."""
        n = len(self)
        if not n:
            return []
        latest = range(max(0, n - LATEST), n)
        return sorted(
            {*latest, *self._covisible(n - 1, latest[0]), self.database.nearest_view(T_WC)}
        )

    def _covisible(self, row: int, before: int) -> list[int]:
        """The keyframes, of the first ``before`` ones, that share most landmarks with the one in
        this row."""
        of_feature = self.landmarks.of_feature
        # the last entry stands for features without a landmark
        is_seen = np.zeros(len(self.landmarks) + 1, bool)
        is_seen[of_feature[row]] = True
        is_seen[-1] = False
        n_shared = np.array([is_seen[f].sum() for f in of_feature[:before]], int)
        return [
            int(r)
            for r in np.argsort(-n_shared, kind="stable")[:COVISIBLE]
            if n_shared[r] >= LEAST_SHARED
        ]

    def relocalise(self, features: Features, *, k: int = 5) -> list[Sighting]:
        """Landmarks in a view, without any earlier pose: those that the ``k`` most similar
        keyframes and their neighbours see.

        A keyframe gives a pose by few matches, and landmarks of several keyframes confirm it or
        not.

        Returns:
            The sighting with most landmarks first; none if the place is unknown.
        """
        sightings = []
        for row, _ in self.database.similar(features, k):
            pose = self.database.compare(features, row)
            if pose is not None:
                local = self._seen_from(sorted({row, *self._covisible(row, len(self))}))
                sightings.append(
                    self.find(features, self.database.T_WC[row] @ pose.T_RQ, local, SEARCHES)
                )
        return sorted(
            (sighting for sighting in sightings if sighting is not None),
            key=lambda sighting: -len(sighting.pairs),
        )

    def find(
        self,
        features: Features,
        T_WC: Float[Tensor, "4 4"],
        local: "_Local",
        searches: tuple[float, ...] = SEARCHES[1:],
    ) -> Sighting | None:
        """Landmarks searched around their predicted pixels, then more closely around those of the
        pose that they give; None if too few agree."""
        T_WC = T_WC.detach().cpu().double()
        for share in searches:
            pairs = found_near(
                self.camera,
                local.xyz_W,
                local.descriptors,
                features,
                T_WC,
                share * self.camera.width,
            )
            if len(pairs) < LEAST_SEEN:
                return None
            rows = self._rows(features, pairs, local)
            T_WC = landmark_pose(rows, T_WC)
            agree = rows.agree(T_WC)
            if int(agree.sum()) < max(LEAST_SEEN, LEAST_SHARE * len(pairs)):
                return None
        pairs = np.stack(
            [pairs[:, 0], local.landmark[pairs[:, 1]]],
            1,
        )
        expected_landmarks = local.landmark[in_view(self.camera, local.xyz_W, T_WC)[1]]
        return Sighting(
            T_WC=T_WC,
            rows=rows[agree],
            pairs=pairs[agree],
            expected=expected_landmarks,
        )

    def _rows(self, features: Features, pairs: ndarray, local: "_Local") -> LandmarkRows:
        feature_rows = pairs[:, 0]
        return LandmarkRows(
            camera=self.camera,
            xyz_W=local.xyz_W[pairs[:, 1]],
            uv=features.uv.numpy()[feature_rows].astype(np.float64),
            inverse_depth=inverse_or_zero(
                features.xyz_C.numpy()[feature_rows, 2].astype(np.float64)
            ),
            # the landmark's own pixel had the same error
            sigma_px=features.sigma_px.numpy()[feature_rows].astype(np.float64) * 2**0.5,
        )

    def _seen_from(self, keyframes: list[int]) -> "_Local":
        landmark, descriptors = self.landmarks.seen_from(keyframes)
        xyz_W = self.landmarks.positions(torch.from_numpy(landmark)).numpy()
        return _Local(keyframes=keyframes, landmark=landmark, xyz_W=xyz_W, descriptors=descriptors)

    def state_dict(self) -> dict[str, Any]:
        """Keyframes and landmarks, as tensors and plain values."""
        local = self._local
        return {
            "database": self.database.state_dict(),
            "landmarks": self.landmarks.state_dict(),
            "local": local
            and {"keyframes": local.keyframes, "landmark": torch.from_numpy(local.landmark)},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace keyframes and landmarks by those of ``state_dict``."""
        self.database.load_state(state["database"])
        self.landmarks.load_state(state["landmarks"])
        self._local = None
        if state["local"] is not None:
            local = self._seen_from(state["local"]["keyframes"])
            self._local = local.part(
                np.isin(local.landmark, state["local"]["landmark"].cpu().numpy())
            )
