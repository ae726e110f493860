"""The places that a tracked camera has seen: they start the tracker, bring it back when it is lost,
and close loops."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .. import tracking
from ..config import TrackingConfig
from ..geometry import se3
from ..types import Camera, Frame

OFF_M = 0.02
OFF_DEG = 1.0
"""ICP starts from the landmarks' pose where it differs by more than this from the predicted one."""


class _Look(NamedTuple):
    """A look at a frame for landmarks."""

    frame_index: int
    features: tracking.Features
    sighting: tracking.Sighting | None
    """The landmarks that it sees; None if too few."""


class KeyframeMemory:
    """Keyframes of a trajectory, in the back end, in a map of landmarks, or only by their
    appearance, as the settings say."""

    def __init__(self, config: TrackingConfig):
        self._config = config
        self.back_end: tracking.BackEnd | None = None
        self._map: tracking.LandmarkMap | None = None
        """Keyframes and landmarks, where the front end or the back end uses landmarks; the back
        end's, if there is one."""
        self._database: tracking.KeyframeDatabase | None = None
        """Keyframes by appearance, to relocalise when tracking is lost; the map's, if there is
        one."""
        self._last_look: _Look | None = None
        """At the frame that was located last."""

    @property
    def camera(self) -> Camera | None:
        """Camera of the keyframes; None if there are none."""
        return None if self._database is None else self._database.camera

    def relocalise(self, frame: Frame) -> list[tuple[Float[Tensor, "4 4"], Any]]:
        """Possible poses of the frame by its appearance, the most likely first, with the rows of
        their landmarks."""
        if self._database is None:
            return []
        sightings = [] if self._map is None else self._map.relocalise(self._features(frame))
        return [
            *((sighting.T_WC, sighting.extra) for sighting in sightings),
            *((T_WC, None) for T_WC in self._database.relocalise(frame)),
        ]

    def sight(
        self, frame: Frame, tracker: tracking.Tracker
    ) -> tuple[tracking.Sighting | None, Float[Tensor, "4 4"] | None]:
        """What the frame sees of the landmarks, and where ICP starts because of it.

        Returns:
            The landmarks, None if they are not wanted or too few; and their pose. It is None where
            it agrees with the predicted one, which then is the more exact start.
        """
        self._last_look = None
        if self._map is None or not self._config.landmarks or frame.camera != self._map.camera:
            return None, None
        features = self._features(frame)
        T_predicted = tracker.predict(frame.timestamp_s)
        sighting = self._map.see(features, T_predicted)
        self._last_look = _Look(frame.index, features, sighting)
        if sighting is None:
            return None, None
        angle_deg, distance_m = se3.motion(T_predicted, sighting.T_WC)
        is_off = distance_m > OFF_M or angle_deg > OFF_DEG
        T_start = sighting.T_WC if is_off else None
        return sighting, T_start

    def add(self, frame: Frame) -> tracking.Correction | None:
        """Make the frame a keyframe if the camera has moved enough; returns the back end's
        correction, if any."""
        T_WC = frame.T_WC_cpu
        if self._database is None:
            back_end = tracking.BackEnd(frame.camera) if self._config.back_end else None
            self._begin(frame.camera, back_end)
        assert self._database is not None
        look = self._look_at(frame)
        if self._map is not None and look is not None and look.sighting is not None:
            self._map.count(look.sighting)
        if len(self._database) and not tracking.moved_enough(self._database.T_WC[-1], T_WC):
            return None
        features = self._features(frame)
        if self.back_end is not None:
            return self.back_end.add(frame, frame.T_WC, features)
        keyframes = self._database if self._map is None else self._map
        keyframes.add(frame.index, T_WC, features)
        return None

    def begin_with(self, places: tracking.Places, camera: Camera) -> None:
        """Take over the keyframes of another run, for frames of a camera."""
        self._begin(camera, None)
        if self._map is not None:
            self._map = places.landmark_map(camera)
            self._database = self._map.database
        else:
            self._database = places.seen_by(camera).database()

    def see_through(self, camera: Camera) -> None:
        """Compare the keyframes of another run with frames of this camera from now on."""
        if camera == self.camera:
            return
        places = self.places({})
        if places is not None:
            self.begin_with(places, camera)

    def collect(self, frame: Frame) -> None:
        """Make a frame with a given pose a keyframe if none was taken near there, so that the map
        can be found again (``places``)."""
        T_WC = frame.T_WC_cpu
        if self._database is None:
            self._begin(frame.camera, None)
        database = self._database
        assert database is not None
        if frame.camera != database.camera:
            return
        if len(database) and not tracking.moved_enough(
            database.T_WC[database.nearest_view(T_WC)], T_WC
        ):
            return
        database.add(frame.index, T_WC, database.extract(frame))

    def places(self, poses: Mapping[int, Tensor]) -> tracking.Places | None:
        """The keyframes, for a file; None if there are none.

        Args:
            poses: Frame index -> camera-to-world pose by now, of those that have another.
        """
        database = self._database
        if database is None or not len(database):
            return None
        T_WC = [
            poses.get(index, T_WC).double().cpu()
            for index, T_WC in zip(database.index, database.T_WC, strict=True)
        ]
        return tracking.Places.of(database, torch.stack(T_WC))

    def finish(self) -> tracking.Correction | None:
        """The last optimisation of the back end, over all keyframes and landmarks, after the
        scan."""
        return None if self.back_end is None else self.back_end.finish()

    def _look_at(self, frame: Frame) -> _Look | None:
        """The last look, if it was at this frame."""
        look = self._last_look
        return look if look is not None and look.frame_index == frame.index else None

    def _features(self, frame: Frame) -> tracking.Features:
        look = self._look_at(frame)
        if look is not None:
            return look.features
        assert self._database is not None
        return self._database.extract(frame)

    def _begin(self, camera: Camera, back_end: tracking.BackEnd | None) -> None:
        self.back_end = back_end
        if back_end is not None:
            self._map = back_end.map
        elif self._config.landmarks and self._config.poses == "tracked":
            self._map = tracking.LandmarkMap(camera)
        self._database = (
            tracking.KeyframeDatabase(camera) if self._map is None else self._map.database
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue: of back end, map and database the one that has the
        others."""
        own_map = None if self.back_end is not None else self._map
        own_database = None if self._map is not None else self._database
        return {
            "camera": None if self.camera is None else vars(self.camera),
            "back_end": None if self.back_end is None else self.back_end.state_dict(),
            "map": None if own_map is None else own_map.state_dict(),
            "database": None if own_database is None else own_database.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        if state["camera"] is not None:
            camera = Camera(**state["camera"])
            back_end = None
            if state["back_end"] is not None:
                back_end = tracking.BackEnd.from_state_dict(camera, state["back_end"])
            self._begin(camera, back_end)
        for name, part in (("map", self._map), ("database", self._database)):
            if state[name] is not None and part is not None:
                part.load_state(state[name])
