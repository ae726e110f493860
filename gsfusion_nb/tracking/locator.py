"""The poses of another recording in a map that does not change.

Each frame is found by what was found before: near the pose that the frames before it predict, or,
where there is none, by appearance in the whole map. Landmarks and ICP against the map's surface
give the pose. It counts only if two things say the same: about as many landmarks confirm it as in
the frames before, or the frame looks like the map there, and landmarks or ICP in every direction of
motion agree. A pose with fewer landmarks than usual is compared with one by appearance in the whole
map: where a pattern repeats along a wall, the landmarks near a wrong pose confirm each other.
"""

import dataclasses
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from ..config import TrackingConfig
from ..errors import SequenceError
from ..geometry import se3
from ..types import Frame
from .attempt import why_no_fit, why_not_alike
from .features import Features
from .icp import ExtraRows
from .landmark_map import LandmarkMap, Sighting
from .places import Places
from .report import Relocaliser, TrackingLostError, TrackingReport
from .surface import SurfaceSource
from .tracker import Tracker

OFF_M = 0.02
OFF_DEG = 1.0
"""ICP starts from the landmarks' pose where it differs by more than this from the predicted one."""

AGREE_M = 0.05
AGREE_DEG = 3.0
"""Landmarks confirm a pose if theirs is within this."""

USUAL_FRAMES = 5
USUAL_SHARE = 0.5
"""With less than this share of the landmarks of the last frames a pose is doubtful. It is compared
with one by appearance, and has to look like the map."""

MOST_LOST = 2
"""After this many frames in a row that were not found, a frame is looked for in the whole map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Location:
    """Where a frame was taken in the map, or why that is not known."""

    T_WC: Float[Tensor, "4 4"] | None
    """Camera-to-world pose, float32; None: the frame was not located."""
    way: str = ""
    """Where ICP started that led to the pose: "the predicted pose", "place 1", ..."""
    n_landmarks: int = 0
    """Landmarks of the map in the frame that agree with the pose."""
    rms_m: float = 0.0
    """Root mean square distance of its points from the map's surface, metres."""
    inlier_share: float = 0.0
    """Share of its pixels with depth that fit the surface."""
    reason: str = ""
    """Why it was not located, as a sentence; "" if it was."""

    @property
    def is_located(self) -> bool:
        """Whether the pose is known."""
        return self.T_WC is not None


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose of a frame."""

    report: TrackingReport
    n_landmarks: int
    """Landmarks that agree with it; 0: too few."""
    tracker: Tracker
    """The tracker that found it."""


class Locator:
    """Finds frames in a map, which it does not change.

    Args:
        places: Keyframes of the map.
        surface: Renders the map's surface.
        config: Pyramid levels and limits.
    """

    def __init__(
        self,
        places: Places,
        surface: SurfaceSource,
        config: TrackingConfig | None = None,
    ):
        self.places = places
        self.surface = surface
        self.config = dataclasses.replace(config or TrackingConfig(), target="model")
        self._landmarks: LandmarkMap | None = None
        self._tracker = Tracker(self.config)
        self._usual: list[int] = []
        """Landmarks in the last frames that were located."""

    def locate(self, frame: Frame) -> Location:
        """The pose of the next frame; its own ``T_WC`` is not used.

        Raises:
            BadFrameError: the frame cannot be used.
        """
        features = self._landmarks_for(frame).database.extract(frame)
        if self._tracker.lost_in_a_row > MOST_LOST:
            self.forget()
        before = self._tracker.standing
        try:
            near = self._near(frame, features)
        except TrackingLostError as e:
            return Location(T_WC=None, reason=str(e))
        self._usual = self._usual[-USUAL_FRAMES:]
        if not self._is_usual(near):
            near = self._best(near, self._anywhere(frame, features))
        reason = self._why_doubtful(frame, near)
        if reason:
            self._tracker.standing = before
            self._tracker.lost_in_a_row += 1
            return Location(T_WC=None, reason=f"frame {frame.index} cannot be located: {reason}")
        self._usual.append(near.n_landmarks)
        fit = near.report.icp
        return Location(
            T_WC=near.report.T_WC,
            way=near.report.start,
            n_landmarks=near.n_landmarks,
            rms_m=fit.rms_m if fit else 0.0,
            inlier_share=fit.inlier_share if fit else 0.0,
        )

    def _is_usual(self, candidate: "_Candidate") -> bool:
        """Whether about as many landmarks agree with a pose as with those before."""
        if not self._usual or not candidate.n_landmarks:
            return False
        return candidate.n_landmarks >= USUAL_SHARE * statistics.median(self._usual)

    def _near(self, frame: Frame, features: Features) -> "_Candidate":
        """The pose near the frames before, or by appearance where there are none."""
        sighting = self._sighting(frame, features)
        report = self._track(frame, features, sighting)
        confirmed = self._confirmed(features, report, sighting)
        return _Candidate(report, 0 if confirmed is None else len(confirmed.pairs), self._tracker)

    def _anywhere(self, frame: Frame, features: Features) -> "_Candidate | None":
        """The pose by appearance in the whole map: a pattern that repeats along a wall may have led
        to a wrong one nearby."""
        tracker = Tracker(self.config)
        try:
            report = tracker.find(frame, self.surface, self._relocaliser(features))
        except TrackingLostError:
            return None
        confirmed = self._confirmed(features, report, None)
        return _Candidate(report, 0 if confirmed is None else len(confirmed.pairs), tracker)

    def _best(self, near: "_Candidate", other: "_Candidate | None") -> "_Candidate":
        """The candidate with more landmarks; the near one if they are the same place."""
        if other is None or other.n_landmarks <= near.n_landmarks:
            return near
        angle_deg, distance_m = se3.motion(near.report.T_WC, other.report.T_WC)
        if distance_m <= AGREE_M and angle_deg <= AGREE_DEG:
            return dataclasses.replace(near, n_landmarks=other.n_landmarks)
        self._tracker = other.tracker
        return other

    def forget(self) -> None:
        """Look for the next frame in the whole map, as if it were the first."""
        self._tracker = Tracker(self.config)
        self._usual = []

    def go_on_from(self, T_WC: Float[Tensor, "4 4"], timestamp_s: float = 0.0) -> None:
        """Look for the next frame near a pose that is known."""
        self.forget()
        self._tracker.begin_at(T_WC, timestamp_s)

    def _landmarks_for(self, frame: Frame) -> LandmarkMap:
        if self._landmarks is None or self._landmarks.camera != frame.camera:
            self._landmarks = self.places.landmark_map(frame.camera)
        return self._landmarks

    def _sighting(self, frame: Frame, features: Features) -> Sighting | None:
        """The landmarks near the predicted pose, if there is one."""
        assert self._landmarks is not None
        if not self._tracker.has_pose:
            return None
        T_predicted = self._tracker.predict(frame.timestamp_s)
        self._landmarks.collect_around(T_predicted)
        return self._landmarks.see(features, T_predicted)

    def _track(self, frame: Frame, features: Features, sighting: Sighting | None) -> TrackingReport:
        tracker = self._tracker
        relocalise = self._relocaliser(features)
        if not tracker.has_pose:
            return tracker.find(frame, self.surface, relocalise)
        guess = None
        if sighting is not None:
            angle_deg, distance_m = se3.motion(tracker.predict(frame.timestamp_s), sighting.T_WC)
            guess = sighting.T_WC if distance_m > OFF_M or angle_deg > OFF_DEG else None
        extra = None if sighting is None else sighting.extra
        return tracker.track(frame, self.surface, relocalise, extra, guess)

    def _relocaliser(self, features: Features) -> Relocaliser:
        """The poses by appearance of a frame with these features."""
        landmarks = self._landmarks
        assert landmarks is not None

        def relocalise(_: Frame) -> list[tuple[Tensor, ExtraRows | None]]:
            seen: list[tuple[Tensor, Any]] = [
                (s.T_WC, s.extra) for s in landmarks.relocalise(features)
            ]
            return seen or [(T_WC, None) for T_WC in landmarks.database.relocalise(features)]

        return relocalise

    def _confirmed(
        self, features: Features, report: TrackingReport, sighting: Sighting | None
    ) -> Sighting | None:
        """The landmarks of the frame, if their pose agrees with the tracked one."""
        assert self._landmarks is not None
        T_WC = report.T_WC.double().cpu()
        if sighting is None:
            self._landmarks.collect_around(T_WC)
            sighting = self._landmarks.see(features, T_WC)
        if sighting is None:
            return None
        angle_deg, distance_m = se3.motion(T_WC, sighting.T_WC)
        return sighting if distance_m <= AGREE_M and angle_deg <= AGREE_DEG else None

    def _why_doubtful(self, frame: Frame, candidate: "_Candidate") -> str:
        """The reason not to believe a pose, or ""."""
        report = candidate.report
        assert report.icp is not None
        if self._is_usual(candidate):
            return ""
        surface = self.surface(frame.camera, report.T_WC)
        problem = why_not_alike(frame, surface, doubtful=True)
        return problem or ("" if candidate.n_landmarks else why_no_fit(report.icp, strict=True))


@runtime_checkable
class FramesByNumber(Protocol):
    """Frames that can be read again, such as a ``Sequence``; one that cannot be read raises a
    ``SequenceError``."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int) -> Frame: ...


def locate_all(locator: Locator, frames: FramesByNumber) -> Iterator[tuple[int, Location]]:
    """Locate the frames of a recording in order, and then those before a frame that was found, from
    there back.

    Args:
        locator: Finds them.
        frames: A sequence; each frame is read once or twice.

    Yields:
        Number of the frame and its location, twice for a frame that was found on the way back.
    """
    n = len(frames)
    poses: dict[int, Tensor] = {}
    for i in range(n):
        location = _located(locator, frames, i)
        if location.T_WC is not None:
            poses[i] = location.T_WC
        yield i, location
    for i in reversed(range(n - 1)):
        if i in poses or i + 1 not in poses:
            continue
        locator.go_on_from(poses[i + 1])
        location = _located(locator, frames, i)
        if location.T_WC is not None:
            poses[i] = location.T_WC
            yield i, location


def _located(locator: Locator, frames: FramesByNumber, i: int) -> Location:
    """Where one frame is; one that cannot be read has no pose."""
    try:
        return locator.locate(frames[i])
    except SequenceError as e:
        return Location(T_WC=None, reason=str(e))
