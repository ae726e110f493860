"""One run over frames that arrive over time, of which only a few are kept."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from torch import Tensor

from ..data import BadFrameError, Sequence, SequenceError, SequenceView
from ..data.stream import BackgroundFrames, Policy, SelectedFrames
from ..mapping import Mapper
from ..mapping.frame_checks import check_frame
from ..mapping.keyframe_passes import KeyframePasses
from ..types import Frame
from .kept_frames import KeptFrames
from .mapping_run import MappingRun


class StreamRun(MappingRun):
    """A mapper and the frames that arrive for it; used like any ``MappingRun``, also in a ``LiveMapper``.

    A second thread receives the frames. Their indices count all that arrive, also dropped ones. Every
    ``data.hold_out_every``-th is held out for scoring, unless the camera is tracked and there are no poses to compare
    with. ``sequence`` holds what is kept: the poses of all mapped frames and the images of a few.

    Args:
        frames: Any iterable of frames, for example a ``LiveSource``; used once.
        mapper: The mapper, such as ``GSFusion(config)``; one that has a map already continues it.
        policy: What happens to frames when mapping is slower than the source
            (``gsfusion_nb.data.stream.POLICIES``); by default the policy of the source, or "all".
        queue_frames: Largest number of waiting frames, for "all" and "queue".
        until: Called while no frame arrives; the stream ends when it returns True.

    Raises:
        SequenceError: The source has no poses and the settings do not ask to track them, or ``data.repair`` is set.
    """

    resumable = False

    def __init__(
        self,
        frames: Iterable[Frame] | Sequence,
        mapper: Mapper,
        *,
        policy: Policy | None = None,
        queue_frames: int = 4,
        until: Callable[[], bool] = lambda: False,
    ):
        name = getattr(frames, "name", "stream")
        self.kept = KeptFrames(name, has_poses=getattr(frames, "has_poses", True))
        super().__init__(self.kept.opened(), mapper)
        self.frames_source = frames
        self.until = until
        self.policy: Policy = policy or getattr(frames, "policy", "all")
        data = self.mapper.config.data
        earlier = self.mapper.localiser.frame_indices
        selected = SelectedFrames(frames, data, name=name, first_index=max(earlier, default=-1) + 1)
        self._feed = BackgroundFrames(selected, policy=self.policy, size=queue_frames, until=lambda: self.until())
        self._n_taken = self.n_unusable = 0
        self._holds_out = data.hold_out_every > 0 and (self.kept.has_poses or not self.mapper.localiser.is_tracking)
        self._n_earlier = len(earlier)
        self.mapper.passes = KeyframePasses()

    @property
    def can_be_saved(self) -> bool:
        """Whether a checkpoint can be saved now; it keeps the map if the process is killed, though not the stream."""
        return not self.mapper.guard.half_mapped

    def state_dict(self) -> dict[str, Any]:
        """The state of the run, and the kept frames of the stream."""
        counts = {"n_taken": self._n_taken, "n_unusable": self.n_unusable, "n_earlier": self._n_earlier}
        return super().state_dict() | {"kept": self.kept.state_dict(), "counts": counts}

    @classmethod
    def after_a_kill(cls, source: dict[str, Any], mapper: Mapper, state: dict[str, Any]) -> "StreamRun":
        """The run of a stream whose process was killed; it gets no more frames."""
        nothing, passes = _Ended(source["stream"], source["has_poses"]), mapper.passes
        run = cls(nothing, mapper, policy=source["policy"])
        mapper.passes = passes
        run.load_state_dict(state)
        run.kept.load_state_dict(state["kept"])
        counts = state["counts"]
        run._n_taken, run.n_unusable, run._n_earlier = counts["n_taken"], counts["n_unusable"], counts["n_earlier"]
        run.sequence = run.kept.opened()
        run._warn(f"the stream was interrupted after {len(run.steps)} frames, when its process was killed")
        return run

    def stream(self) -> dict[str, Any]:
        """Name and policy of the stream, for ``after_a_kill``."""
        return {"stream": self.kept.name, "has_poses": self.kept.has_poses, "policy": self.policy}

    def constant_tensors(self) -> list[Tensor]:
        """Also the images of the kept frames."""
        frames = [*self.kept.kept_mapped.items, *self.kept.kept_held_out.items]
        return [*super().constant_tensors(), *(image for f in frames for image in (f.colour, f.depth_m))]

    def frames(self) -> "_Feed":
        """The frames that come, without those held out."""
        return _Feed(self)

    @property
    def poses(self) -> list[Any]:
        """Camera-to-world pose [4, 4] of every frame of this run, as given, or as tracked and corrected so far."""
        return self.mapper.localiser.poses[self._n_earlier :]

    def mapped_views(self, limit: int) -> SequenceView:
        """At most ``limit`` of the kept mapped frames, evenly spread."""
        kept = [frame.index for frame in self.kept.kept_mapped.items]
        return self.kept.view(kept[:: -(-len(kept) // limit)] if kept else [])

    def extra_metrics(self) -> dict[str, Any]:
        """Numbers of frames received, dropped and unusable, and the policy."""
        return {
            "n_frames_received": self._feed.queue.n_received,
            "n_frames_dropped": self._feed.queue.n_dropped,
            "n_frames_unusable": self.n_unusable,
            "policy": self.policy,
        }

    def next_frame(self) -> Frame:
        """The next frame to map; held-out frames are stored and passed over."""
        data = self.mapper.config.data
        while True:
            try:
                frame = next(self._feed)
            except StopIteration:
                self._note_the_end()
                raise
            i = self._n_taken
            self._n_taken += 1
            if not (self._holds_out and i % data.hold_out_every == data.hold_out_offset):
                return frame
            self.kept.hold_out(check_frame(frame))
            self.sequence = self.kept.opened()

    def close(self) -> None:
        """Stop reading from the source."""
        self._feed.close()

    def _passed(self, frame: Frame | None) -> None:
        if frame is None:
            self.n_unusable += 1
            return
        self.kept.add(frame)
        self.next_position = len(self.kept.mapped)
        if len(self.kept.mapped) == 1:
            self.sequence = self.kept.opened()  # its camera is known now

    def _note_the_end(self) -> None:
        broke_off = getattr(self.frames_source, "broke_off", "")
        if broke_off and self.status == "running":
            self.status = "stopped"
            self._warn(f"{broke_off}; everything mapped before is kept")

    def _can_go_on(self, error: SequenceError) -> bool:
        return isinstance(error, BadFrameError)  # any other came from the source and ended it

    def _why_nothing(self) -> str:
        if not self.warnings:
            return f"no frame came from {self.sequence.name}"
        reason = self.warnings[0].removeprefix("skipped a frame: ").removesuffix("; everything mapped before is kept")
        return f"no frame of {self.sequence.name} could be mapped, the first because {reason}"


class _Ended:
    """A stream without further frames."""

    def __init__(self, name: str, has_poses: bool):
        self.name, self.has_poses = name, has_poses

    def __iter__(self) -> Iterator[Frame]:
        return iter(())


class _Feed:
    """The frames of a run in order; closing it ends the source."""

    def __init__(self, run: StreamRun):
        self._run = run

    def __next__(self) -> Frame:
        return self._run.next_frame()

    def close(self) -> None:
        """Stop: no more frames will be read."""
        self._run.close()
