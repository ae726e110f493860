"""The pose of each frame, given by the data or tracked against the map; the trajectory and its
corrections."""

import bisect
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import tracking
from ..config import TrackingConfig
from ..errors import BadFrameError
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import KeyframeList
from ..types import Camera, Frame

OFF_M = 0.02
OFF_DEG = 1.0
"""ICP starts from the landmarks' pose where it differs by more than this from the predicted one."""

FASTEST_M_S = 20.0
FASTEST_DEG_S = 1500.0
"""No camera in a hand, on a robot or on a slow car moves or turns faster."""
FARTHEST_STEP_M = 2.0
FARTHEST_STEP_DEG = 120.0
"""Up to this for each frame between them two poses are no jump at any speed: time stamps may be
missing or wrong."""

_BLOCK = 1024
"""Number of poses that are stored in one tensor."""


class Localiser:
    """The trajectory of a run, one pose per mapped frame.

    With ``config.poses == "given"`` a frame keeps its pose. With "tracked" only the first does; the
    others are aligned to the map (Peng et al. 2024, Eq. 10), and the back end, where enabled,
    corrects the trajectory when a loop closes.
    """

    def __init__(self, config: TrackingConfig):
        self.config = config
        self.poses: list[Float[Tensor, "4 4"]] = []
        """Camera-to-world pose of every mapped frame, on the CPU; corrected when a loop closes."""
        self.given: list[Float[Tensor, "4 4"]] = []
        """The same poses before pictures refined them; the same tensors where none did."""
        self.frame_indices: list[int] = []
        self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_kept = 0
        self.report: dict[str, Any] = {}
        """How the last frame was tracked: status, rms_m, inlier_share. Empty for given poses."""
        self.jump = ""
        """How far the given pose of the last frame is from those before, if no camera moves so
        fast; else empty."""
        self._mapped: dict[str, Any] | None = None
        self._refused: dict[str, Any] | None = None
        """Index, time and given pose of the frame mapped last, and of one refused since: the next
        may go on there."""
        self._tracker = tracking.Tracker(config)
        self._state_before: Any = None
        """State of the tracker before the frame that it was given last, until that frame is
        recorded or refused."""
        self._back_end: tracking.BackEnd | None = None
        self._map: tracking.LandmarkMap | None = None
        """Keyframes and landmarks, where the front end or the back end uses landmarks; the back
        end's, if there is one."""
        self._database: tracking.KeyframeDatabase | None = None
        """Keyframes by appearance, to relocalise when tracking is lost; the map's, if there is
        one."""
        self._view: tuple[int, tracking.Features, tracking.Sighting | None] | None = None
        """Index of the frame that was located last, its features, and the landmarks that it
        sees."""

    @property
    def is_tracking(self) -> bool:
        """Whether poses are estimated."""
        return self.config.poses == "tracked"

    @property
    def frames_lost(self) -> int:
        """Number of frames in a row that could not be tracked, up to the last one; 0 if that one
        was."""
        return self._tracker.lost_in_a_row

    @property
    def is_refined(self) -> bool:
        """Whether pictures have moved a pose away from the given one (``optim.refine_poses``)."""
        return any(pose is not given for pose, given in zip(self.poses, self.given, strict=False))

    def refine(self, row: int, T_WC: Float[Tensor, "4 4"]) -> None:
        """Give the mapped frame with this number another pose; ``given`` keeps the one before."""
        if self.poses[row] is self.given[row]:
            self.poses[row] = self._kept(self.given[row])
        self.poses[row].copy_(T_WC)

    def undo_of_refinement(self) -> Callable[[], None]:
        """A function that undoes what ``refine`` and ``follow`` change from now on."""
        poses = list(self.poses)
        values = [pose.clone() for pose in poses]

        def undo() -> None:
            self.poses = list(poses)
            for pose, value in zip(self.poses, values, strict=True):
                pose.copy_(value)

        return undo

    def follow(self, rows: list[int]) -> None:
        """Refine the frames between those with the numbers ``rows``, which were refined: each by
        what they were."""
        indices = torch.tensor([self.frame_indices[row] for row in rows])
        moved = self._twists(rows)
        for row in set(range(len(self.poses))) - set(rows):
            xi = between(indices, moved, self.frame_indices[row])
            self.refine(
                row,
                (self.given[row].double() @ se3.exp(xi)).float(),
            )

    def refined(
        self,
        index: int,
        T_WC: Float[Tensor, "4 4"],
    ) -> Float[Tensor, "4 4"]:
        """The given pose of any frame of the source, moved as the mapped frames before and after it
        were refined."""
        if not self.is_refined:
            return T_WC
        moved = self._twists(range(len(self.poses)))
        xi = between(torch.tensor(self.frame_indices), moved, index)
        return (T_WC.double() @ se3.exp(xi)).to(T_WC)

    def pose_near(self, index: int) -> Float[Tensor, "4 4"]:
        """A pose between those of the mapped frames before and after any frame of the source, or
        the first or last."""
        poses = torch.stack(self.poses).double()
        after = bisect.bisect(self.frame_indices, index)
        if after in (0, len(poses)):
            return poses[min(after, len(poses) - 1)]
        there, here = self.frame_indices[after - 1 : after + 1]
        step = se3.log(se3.inverse(poses[after - 1]) @ poses[after])
        return poses[after - 1] @ se3.exp((index - there) / (here - there) * step)

    def _twists(self, rows: Iterable[int]) -> Float[Tensor, "R 6"]:
        """How far some frames were refined, each in its camera's frame."""
        given, poses = (
            torch.stack([p[row] for row in rows]).double() for p in (self.given, self.poses)
        )
        return se3.log(se3.inverse(given) @ poses)

    @property
    def camera(self) -> Camera | None:
        """Camera of the keyframes used for relocalisation; None if there are none."""
        return None if self._database is None else self._database.camera

    def locate(self, frame: Frame, surface: tracking.SurfaceSource) -> Frame:
        """The frame with its pose in the map.

        Raises:
            BadFrameError: tracking is lost and could not recover with this frame; or the given pose
                is a jump that no camera makes, both from the last mapped frame and from a frame
                just refused.
        """
        self.report = {}
        self._state_before = None
        if not self.is_tracking:
            self._check_jump(frame)
            return frame
        self._state_before = self._tracker.standing
        seen, guess = self._see(frame)
        try:
            if seen is None:
                pose = self._tracker.track(frame, surface, self._relocalise)
            else:
                extra = seen.extra
                pose = self._tracker.track(frame, surface, self._relocalise, extra, guess)
        except tracking.TrackingLostError as e:
            raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
        fit = pose.icp
        self.report = {
            "status": pose.status,
            "rms_m": fit.rms_m if fit else 0.0,
            "inlier_share": fit.inlier_share if fit else 0.0,
        }
        if pose.doubt:
            self.report["doubt"] = pose.doubt
        return dataclasses.replace(frame, T_WC=pose.T_WC.to(frame.T_WC))

    def _check_jump(self, frame: Frame) -> None:
        self.jump = "" if self._mapped is None else jump_from(self._mapped, frame)
        goes_on = self._refused is not None and not jump_from(self._refused, frame)
        if self.jump and self.config.pose_jumps == "skip" and not goes_on:
            self._refused = _stand_of(frame)
            raise BadFrameError(
                f"frame {frame.index} cannot be mapped: {self.jump}. Frames that go on from there "
                "are mapped. If the pose is right: --tracking.pose-jumps map"
            )

    def take_back(self, *, was_refused: bool = False) -> None:
        """Undo the last ``locate``, because its frame was not mapped.

        Args:
            was_refused: The frame cannot be used. A frame that could not be tracked then counts as
                lost.
        """
        if self._state_before is not None and not (was_refused and not self.report):
            self._tracker.standing = self._state_before
        self._state_before = None

    def record(self, frame: Frame) -> tracking.Correction | None:
        """Add a mapped frame to the trajectory. If it closed a loop, returns the correction
        (applied to ``poses``)."""
        self._state_before = None
        self.poses.append(self._kept(frame.T_WC_cpu))
        self.given.append(self.poses[-1])
        self.frame_indices.append(frame.index)
        if not self.is_tracking:
            self._mapped = _stand_of(frame)
            self._refused = None
            return None
        return self._remember(frame)

    def _relocalise(
        self,
        frame: Frame,
    ) -> list[tuple[Float[Tensor, "4 4"], Any]]:
        """Possible poses of the frame by its appearance, the most likely first, with the rows of
        their landmarks."""
        if self._database is None:
            return []
        seen = [] if self._map is None else self._map.relocalise(self._features(frame))
        return [
            *((s.T_WC, s.extra) for s in seen),
            *((T_WC, None) for T_WC in self._database.relocalise(frame)),
        ]

    def _see(
        self,
        frame: Frame,
    ) -> tuple[tracking.Sighting | None, Float[Tensor, "4 4"] | None]:
        """Landmarks that the frame sees, None if they are not wanted, or too few; and their pose,
        if the predicted one is wrong. If it is not, it is the more exact start for ICP."""
        self._view = None
        if self._map is None or not self.config.landmarks or frame.camera != self._map.camera:
            return None, None
        features = self._features(frame)
        predicted = self._tracker.predict(frame.timestamp_s)
        seen = self._map.see(features, predicted)
        self._view = frame.index, features, seen
        if seen is None:
            return None, None
        turned_deg, moved_m = se3.motion(predicted, seen.T_WC)
        return seen, seen.T_WC if moved_m > OFF_M or turned_deg > OFF_DEG else None

    def _features(self, frame: Frame) -> tracking.Features:
        if self._view is not None and self._view[0] == frame.index:
            return self._view[1]
        assert self._database is not None
        return self._database.extract(frame)

    def _kept(self, T_WC: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """A copy of the pose inside a larger tensor.

        A small tensor of its own per frame, between the large ones of the frames, would prevent the
        allocator from reusing the frames' memory: measured, 50 to 220 kB lost per frame of 160x120.
        """
        n = self._n_kept % _BLOCK
        if n == 0:
            self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_kept += 1
        return self._block[n].copy_(T_WC)

    def _remember(self, frame: Frame) -> tracking.Correction | None:
        """Make the frame a keyframe if the camera has moved enough; returns the back end's
        correction, if any."""
        T_WC = frame.T_WC_cpu
        if self._database is None:
            self._use(
                frame.camera, tracking.BackEnd(frame.camera) if self.config.back_end else None
            )
        assert self._database is not None
        index, _, seen = self._view or (None, None, None)
        if self._map is not None and seen is not None and index == frame.index:
            self._map.count(seen)
        if len(self._database) and not tracking.moved_enough(self._database.T_WC[-1], T_WC):
            return None
        features = self._features(frame)
        if self._back_end is not None:
            return self._apply(self._back_end.add(frame, frame.T_WC, features))
        known = self._database if self._map is None else self._map
        known.add(frame.index, T_WC, features)
        return None

    def _use(self, camera: Camera, back_end: tracking.BackEnd | None) -> None:
        """Begin to remember keyframes: in the back end, in a map of landmarks, or only by their
        appearance."""
        self._back_end = back_end
        if back_end is not None:
            self._map = back_end.map
        elif self.config.landmarks:
            self._map = tracking.LandmarkMap(camera)
        self._database = (
            tracking.KeyframeDatabase(camera) if self._map is None else self._map.database
        )

    def finish(self) -> tracking.Correction | None:
        """The last optimisation of the back end, over all keyframes and landmarks, after the
        scan."""
        return None if self._back_end is None else self._apply(self._back_end.finish())

    def _apply(self, correction: tracking.Correction | None) -> tracking.Correction | None:
        if correction is None:
            return None
        moves = correction.transform_of(torch.tensor(self.frame_indices)).float()
        old = self.poses
        self.poses = [T @ pose for T, pose in zip(moves, self.poses, strict=True)]
        pairs = zip(moves, self.poses, old, self.given, strict=True)
        self.given = [new if given is pose else T @ given for T, new, pose, given in pairs]
        self._tracker.correct(moves[-1])
        return correction

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue."""
        return {
            "poses": torch.stack(self.poses) if self.poses else torch.zeros(0, 4, 4),
            "given": torch.stack(self.given) if self.is_refined else None,
            "frame_indices": torch.tensor(self.frame_indices, dtype=torch.int64),
            "stands": [self._mapped, self._refused],
            "tracker": self._tracker.state_dict(),
            "camera": None if self.camera is None else vars(self.camera),
            "back_end": None if self._back_end is None else self._back_end.state_dict(),
            "map": None
            if self._map is None or self._back_end is not None
            else self._map.state_dict(),
            "database": None
            if self._database is None or self._map is not None
            else self._database.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.frame_indices = state["frame_indices"].tolist()
        self.poses = [self._kept(T_WC) for T_WC in state["poses"].cpu()]
        self.given = list(self.poses)
        if state["given"] is not None:
            self.given = [self._kept(T_WC) for T_WC in state["given"].cpu()]
        self._mapped, self._refused = state["stands"]
        self._tracker = tracking.Tracker.from_state_dict(self.config, state["tracker"])
        if state["camera"] is not None:
            camera = Camera(**state["camera"])
            saved = state["back_end"]
            self._use(
                camera, None if saved is None else tracking.BackEnd.from_state_dict(camera, saved)
            )
        for name, part in (("map", self._map), ("database", self._database)):
            if state[name] is not None and part is not None:
                part.load_state(state[name])


def _stand_of(frame: Frame) -> dict[str, Any]:
    """Where a frame was taken, and when."""
    return {"index": frame.index, "timestamp_s": frame.timestamp_s, "T_WC": frame.T_WC_cpu.clone()}


def jump_from(stand: dict[str, Any], frame: Frame) -> str:
    """How far the pose of a frame is from ``stand`` of an earlier one, in words, if no camera moves
    so fast."""
    turned_deg, moved_m = (float(x) for x in se3.motion(stand["T_WC"], frame.T_WC_cpu))
    seconds = max(frame.timestamp_s - stand["timestamp_s"], 0.0)
    frames = max(abs(frame.index - stand["index"]), 1)
    most_m = max(FARTHEST_STEP_M * frames, FASTEST_M_S * seconds)
    most_deg = max(FARTHEST_STEP_DEG * frames, FASTEST_DEG_S * seconds)
    if moved_m <= most_m and turned_deg <= most_deg:
        return ""
    return (
        f"its pose is {moved_m:.3g} m and {turned_deg:.0f} degrees from that of frame "
        f"{stand['index']}, {seconds:.3g} s before; a camera moves at most {most_m:.3g} m and "
        f"{min(most_deg, 180):.0f} degrees"
    )


def between(
    indices: Int[Tensor, " R"], values: Float[Tensor, "R D"], index: int
) -> Float[Tensor, " D"]:
    """Values at increasing numbers of frames, interpolated for another frame; outside of them the
    first or last."""
    after = int(torch.searchsorted(indices, index).clamp(1, max(len(indices) - 1, 1)))
    if len(indices) == 1:
        return values[0]
    first = int(indices[after - 1])
    last = int(indices[after])
    share = min(max((index - first) / max(last - first, 1), 0.0), 1.0)
    return (1 - share) * values[after - 1] + share * values[after]


def move_map(
    correction: tracking.Correction, gaussians: GaussianModel, keyframes: KeyframeList
) -> None:
    """Move Gaussians and keyframes with a corrected trajectory: each with the keyframes around its
    frame."""
    gaussians.move(correction.transform_of(gaussians.birth_frame))
    if len(keyframes):
        keyframes.move(correction.transform_of(torch.tensor([k.index for k in keyframes])))
