"""Camera tracking in a growing map: predict the pose, align it, check the fit, and try other starts
if it is bad."""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..checks import check_pose
from ..config import TrackingConfig
from ..geometry import se3
from ..types import Camera, Frame
from .attempt import (
    Attempt,
    Sight,
    Start,
    UsualFit,
    attempt,
    best_of,
    why_no_fit,
    why_not_alike,
    why_too_far,
)
from .camera_path import CameraPath, TrackedPose
from .icp import ExtraRows
from .report import PoseFinder, Relocaliser, TrackingLostError, TrackingReport
from .surface import Surface, SurfaceSource, hybrid_surface


@dataclass(frozen=True, kw_only=True, eq=False)
class _OwnFrame:
    """An earlier frame that the model is mixed with: its pose (float64), depth and, if it is used,
    colours."""

    T_WC: Tensor
    depth_m: Tensor
    rgb: Tensor | None


class Tracker:
    """Frame-to-model tracking (Peng et al. 2024, section 3.2, "Camera tracking").

    Args:
        config: Pyramid levels, limits, prediction, and what counts as failure.
    """

    def __init__(self, config: TrackingConfig | None = None):
        self.config = config or TrackingConfig()
        self.lost_in_a_row = 0
        """Number of frames that could not be tracked, up to the last one."""
        self._path = CameraPath()
        self._own: _OwnFrame | None = None
        """The frame that a hybrid target is mixed with."""
        self._usual = UsualFit()

    @property
    def standing(self) -> tuple[Any, ...]:
        """The state of the path (last poses and last frame), opaque to others, so that a step can
        be undone."""
        return self._path, self.lost_in_a_row, self._own, self._usual.fits

    @standing.setter
    def standing(self, standing: tuple[Any, ...]) -> None:
        self._path, self.lost_in_a_row, self._own, self._usual.fits = standing

    def track(
        self,
        frame: Frame,
        surface: SurfaceSource,
        relocalise: Relocaliser = lambda frame: [],
        extra: ExtraRows | None = None,
        guess: Float[Tensor, "4 4"] | None = None,
    ) -> TrackingReport:
        """Pose of the next frame. That of the first frame is taken from the data.

        ICP starts from ``guess``, if there is one, or from the predicted pose. If that fails, it
        starts again from the predicted pose, also with smoothed normals, from the last pose, from
        the last pose with wide limits, and from the poses of ``relocalise``. For each start the
        frame is aligned with the model as rendered from it, and the result is accepted if it fits.

        A pose that fits, but much worse than those of the last frames, is accepted only if the
        frame looks there like the model, and no other start leads to a pose that fits better.

        Args:
            frame: Its ``T_WC`` is used only if it is the first.
            surface: Renders the model; may be called several times.
            relocalise: Called for poses by appearance when ICP has failed from all other starts.
            extra: Further rows for ICP, such as landmarks that the frame sees.
            guess: The pose that they give; ICP starts from it first.

        Raises:
            TrackingLostError: no start led to a pose that fits. Only the count of lost frames
                changes, so the next frame is tried again.
        """
        sight = Sight.of(frame, self.config, extra)
        if not sight.has_depth:
            raise self._lost(
                f"frame {frame.index} cannot be tracked: none of its pixels have usable depth"
            )
        if self._path.last is None:
            return self._first(frame)
        failures: list[str] = []
        fits: list[Attempt] = []
        mixed_surface = self._target(surface)
        doubt = ""
        first_try = False
        for start in self._starts(frame, relocalise, fits, guess):
            with_rows = dataclasses.replace(sight, extra=start.extra or extra)
            result = attempt(with_rows, surface, mixed_surface, start, self.config)
            problem = self._problem(
                result, frame, surface, strict=bool(failures or fits) or self.lost_in_a_row > 0
            )
            if problem:
                failures.append(f"from {start.name} {problem}")
                continue
            fits.append(result)
            if len(fits) == 1:
                first_try = not failures
                doubt = self._usual.why_unusual(result.result) if first_try else ""
            if not doubt:
                break
        if not fits:
            raise self._lost(f"frame {frame.index} cannot be tracked: {'; '.join(failures)}")
        best = best_of(sight, fits, self.config)
        has_velocity = self.lost_in_a_row == 0 and not best.start.anywhere
        self._usual.add(best.result)
        self._accept(frame, best.result.T_WC, moved=has_velocity)
        first_try = best.start.smooth or (first_try and best is fits[0])
        return TrackingReport(
            status="recovered"
            if not first_try
            else "degenerate"
            if best.result.degenerate
            else "ok",
            T_WC=best.result.T_WC.to(frame.T_WC),
            start=best.start.name,
            doubt=doubt,
            icp=best.result,
        )

    def track_by(self, find: PoseFinder, frame: Frame) -> TrackingReport:
        """Pose of the next frame as somebody else's tracking finds it. That of the first frame is
        taken from the data.

        Args:
            find: Finds it from the predicted pose.
            frame: Its ``T_WC`` is used only if it is the first.

        Raises:
            TrackingLostError: ``find`` raises it, or its pose is farther away than a camera moves
                between two frames (``max_step_m``, ``max_step_deg``). Only the count of lost frames
                changes, so the next frame is tried again.
            ValueError: what ``find`` returns is no rigid motion.
        """
        if self._path.last is None:
            return self._first(frame)
        T_predicted = self.predict(frame.timestamp_s).to(frame.T_WC)
        try:
            T_WC = find(frame, T_predicted).detach()
        except TrackingLostError as e:
            raise self._lost(f"frame {frame.index} cannot be tracked: {e}") from None
        check_pose(f"the tracked T_WC of frame {frame.index}", T_WC)
        T_on_cpu = se3.rigid(T_WC.double().cpu())
        frames = 1 + self.lost_in_a_row
        if problem := why_too_far(self._path.last.T_WC, T_on_cpu, self.config, frames=frames):
            raise self._lost(f"frame {frame.index} cannot be tracked: {problem}")
        status = "ok" if self.lost_in_a_row == 0 else "recovered"
        self._accept(frame, T_on_cpu, moved=self.lost_in_a_row == 0)
        return TrackingReport(status=status, T_WC=T_on_cpu.to(frame.T_WC))

    def find(self, frame: Frame, surface: SurfaceSource, relocalise: Relocaliser) -> TrackingReport:
        """Pose of a frame in a map where the camera was not seen before: by appearance alone, and
        then by ICP.

        ``track`` goes on from there. A pose must look like the map, and fit it as well as after a
        failed prediction, unless landmarks confirm it.

        Args:
            frame: Its ``T_WC`` is not used.
            surface: Renders the map; may be called several times.
            relocalise: Gives the starting poses.

        Raises:
            TrackingLostError: no start led to a pose that fits, or there was none.
        """
        sight = Sight.of(frame, self.config)
        if not sight.has_depth:
            raise self._lost(
                f"frame {frame.index} cannot be tracked: none of its pixels have usable depth"
            )
        failures: list[str] = []
        for start in _places(frame, relocalise):
            with_rows = dataclasses.replace(sight, extra=start.extra)
            fit = attempt(with_rows, surface, surface, start, self.config)
            problem = why_no_fit(fit.result, strict=start.extra is None) or why_not_alike(
                frame, surface(frame.camera, fit.result.T_WC.float()), doubtful=False
            )
            if problem:
                failures.append(f"from {start.name} {problem}")
                continue
            self._usual.add(fit.result)
            self._accept(frame, fit.result.T_WC, moved=False)
            return TrackingReport(
                status="located",
                T_WC=fit.result.T_WC.to(frame.T_WC),
                start=start.name,
                icp=fit.result,
            )
        reason = "; ".join(failures) or "it looks like no place of the map"
        raise self._lost(f"frame {frame.index} cannot be tracked: {reason}")

    @property
    def has_pose(self) -> bool:
        """Whether a frame was tracked, so that the next can be predicted."""
        return self._path.last is not None

    def begin_at(self, T_WC: Float[Tensor, "4 4"], timestamp_s: float) -> None:
        """Go on from a pose that is known, as if the frame of that time had been tracked."""
        check_pose("T_WC", T_WC)
        pose = TrackedPose(T_WC=T_WC.double().cpu(), timestamp_s=timestamp_s)
        self._path = CameraPath(last=pose)
        self._own = None
        self.lost_in_a_row = 0

    def _problem(
        self, found: Attempt, frame: Frame, surface: SurfaceSource, *, strict: bool
    ) -> str:
        """The reason to reject the pose that an attempt found, or "".  ``strict``: an earlier start
        has failed."""
        last = self._path.last
        assert last is not None
        result = found.result
        problem = why_no_fit(result, strict=strict and found.start.extra is None)
        if not problem and not found.start.anywhere:
            problem = why_too_far(
                last.T_WC, result.T_WC, self.config, frames=1 + self.lost_in_a_row
            )
        if not problem and (strict or self._usual.why_unusual(result)):
            problem = why_not_alike(
                frame, surface(frame.camera, result.T_WC.float()), doubtful=not strict
            )
        return problem

    def correct(self, T_change: Float[Tensor, "4 4"]) -> None:
        """Apply a correction by the back end to the last poses (``CameraPath.corrected``)."""
        check_pose("T_change", T_change)
        change = T_change.double().cpu()
        self._path = self._path.corrected(change)
        self._own = self._own and dataclasses.replace(
            self._own, T_WC=se3.rigid(change @ self._own.T_WC)
        )

    def predict(self, timestamp_s: float) -> Float[Tensor, "4 4"]:
        """Predicted pose at a time (``CameraPath.predict``), float64.

        Raises:
            ValueError: before the first frame.
        """
        return self._path.predict(timestamp_s, prior=self.config.prior)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue later from exactly this state, as tensors and plain
        values."""
        return {
            "lost_in_a_row": self.lost_in_a_row,
            **self._path.state_dict(),
            "own": self._own and dataclasses.asdict(self._own),
            "usual_fit": list(self._usual.fits),
        }

    @classmethod
    def from_state_dict(cls, config: TrackingConfig, state: dict[str, Any]) -> "Tracker":
        """The tracker that was saved with ``state_dict``; the settings are stored elsewhere."""
        tracker = cls(config)
        tracker.lost_in_a_row = state["lost_in_a_row"]
        tracker._path = CameraPath.from_state_dict(state)
        tracker._own = state["own"] and _OwnFrame(**state["own"])
        tracker._usual.fits = [(rms_m, share) for rms_m, share in state["usual_fit"]]
        return tracker

    def _starts(
        self, frame: Frame, relocalise: Relocaliser, fits: list[Attempt], guess: Tensor | None
    ) -> Iterator[Start]:
        """The starting poses of ICP, in order; those by appearance only while ``fits`` is empty."""
        last = self._path.last
        assert last is not None
        if guess is not None:
            yield Start("the landmarks", guess)
        if self.lost_in_a_row == 0:
            T_predicted = self.predict(frame.timestamp_s)
            yield Start("the predicted pose", T_predicted)
            yield Start("the predicted pose with smooth normals", T_predicted, smooth=True)
        if self.lost_in_a_row > 0 or self._path.last_but_one is not None:
            yield Start("the last pose", last.T_WC)
        yield Start("the last pose with wide limits", last.T_WC, wide=True)
        if not fits:
            yield from _places(frame, relocalise)

    def _target(self, source: SurfaceSource) -> SurfaceSource:
        """What ICP aligns a frame with: the model, or the model mixed with the last frame, seen
        from that frame."""
        own = self._own
        if own is None:
            return source

        @functools.cache
        def seen(camera: Camera) -> Surface:
            model = source(camera, own.T_WC.float())
            device = model.depth_m.device
            return hybrid_surface(
                model,
                own.depth_m.to(device),
                None if own.rgb is None else own.rgb.to(device),
            )

        return lambda camera, T_WC: seen(camera)

    def _first(self, frame: Frame) -> TrackingReport:
        """The first frame, whose pose is that of the data."""
        check_pose(f"T_WC of frame {frame.index}", frame.T_WC)
        self._accept(frame, frame.T_WC.double().cpu(), moved=False)
        return TrackingReport(status="first", T_WC=frame.T_WC)

    def _accept(self, frame: Frame, T_WC: Tensor, *, moved: bool) -> None:
        pose = TrackedPose(T_WC=T_WC, timestamp_s=frame.timestamp_s)
        self._path = self._path.then(pose, moved=moved)
        self.lost_in_a_row = 0
        if self.config.target == "hybrid":
            rgb = frame.rgb if self.config.brightness_m else None
            self._own = _OwnFrame(T_WC=T_WC, depth_m=frame.depth_m, rgb=rgb)

    def _lost(self, reason: str) -> TrackingLostError:
        self.lost_in_a_row += 1
        return TrackingLostError(reason)


def _places(frame: Frame, relocalise: Relocaliser) -> Iterator[Start]:
    """Starts of ICP by the appearance of a frame."""
    for n, (T_WC, extra) in enumerate(relocalise(frame)):
        yield Start(
            f"place {n + 1}",
            T_WC.double().cpu(),
            wide=extra is None,
            anywhere=True,
            extra=extra,
        )
