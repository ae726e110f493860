"""One run over frames that arrive over time, of which only a few are kept."""

import bisect
from array import array
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import BadFrameError, FrameSubset, OpenedSequence, Sequence, SequenceError
from ..data.stream import BackgroundFrames, Policy, SelectedFrames
from ..mapping import Mapper
from ..mapping.after_scan import KeyframePasses
from ..mapping.check_frame import check_frame
from ..types import Camera, Frame
from .mapping_run import MappingRun

MOST_VIEWS = 24
"""At most this many mapped frames are kept, and as many held-out ones: 2.1 MB each at 640x480."""

_UNKNOWN = Camera(
    width=1,
    height=1,
    fx=1.0,
    fy=1.0,
    cx=0.5,
    cy=0.5,
)


class StreamRun(MappingRun):
    """A mapper and the frames that arrive for it; used like any ``MappingRun``, also in a
    ``LiveMapper``.

    A second thread receives the frames. Their indices count all that arrive, also dropped ones.
    Every ``data.hold_out_every``-th is held out for scoring, unless the camera is tracked and there
    are no poses to compare with. ``sequence`` holds what is kept: the poses of all mapped frames
    and the images of a few.

    Args:
        frames: Any iterable of frames, for example a ``LiveSource``; used once.
        mapper: The mapper, such as ``GSFusion(config)``; one that has a map already continues it.
        policy: What happens to frames when mapping is slower than the source
            (``gsfusion_nb.data.stream.POLICIES``); by default the policy of the source, or "all".
        until: Called while no frame arrives, or none can be mapped; the stream ends when it returns
            True.
        parent: As for ``MappingRun``.

    Raises:
        SequenceError: The source has no poses and the settings do not ask to track them, or
            ``data.repair`` is set.
    """

    resumable = False

    def __init__(
        self,
        frames: Iterable[Frame] | Sequence,
        mapper: Mapper,
        *,
        policy: Policy | None = None,
        until: Callable[[], bool] = lambda: False,
        parent: dict[str, Any] | None = None,
    ):
        name = getattr(frames, "name", "stream")
        self.kept = KeptFrames(name, has_poses=getattr(frames, "has_poses", True))
        super().__init__(self.kept.opened(), mapper, parent=parent)
        self.views = self.kept
        self.frames_source = frames
        self.until = until
        self.policy: Policy = policy or getattr(frames, "policy", "all")
        data = self.mapper.config.data
        earlier = self.mapper.trajectory.frame_indices
        selection = SelectedFrames(
            frames,
            data,
            name=name,
            first_index=max([-1, *earlier]) + 1,  # frames of a run before have numbers below 0
        )
        self._feed = BackgroundFrames(selection, policy=self.policy, until=lambda: self.until())
        self._n_taken = self.n_unusable = 0
        self._holds_out = data.hold_out_every > 0 and (
            self.kept.has_poses or not self.mapper.localiser.is_tracking
        )
        self._n_earlier = len(earlier)
        self.mapper.passes = KeyframePasses()

    @property
    def can_be_saved(self) -> bool:
        """Whether a checkpoint can be saved now; it keeps the map if the process is killed, though
        not the stream."""
        return not self.mapper.guard.half_mapped

    def state_dict(self) -> dict[str, Any]:
        """The state of the run, and the kept frames of the stream."""
        counts = {
            "n_taken": self._n_taken,
            "n_unusable": self.n_unusable,
            "n_earlier": self._n_earlier,
        }
        return super().state_dict() | {"kept": self.kept.state_dict(), "counts": counts}

    @classmethod
    def after_a_kill(
        cls, source: dict[str, Any], mapper: Mapper, state: dict[str, Any]
    ) -> "StreamRun":
        """The run of a stream whose process was killed; it gets no more frames."""
        nothing = KeptFrames(source["stream"], has_poses=source["has_poses"])
        passes = mapper.passes
        run = cls(nothing, mapper, policy=source["policy"])
        mapper.passes = passes
        run.load_state_dict(state)
        run.kept.load_state_dict(state["kept"])
        counts = state["counts"]
        run._n_taken = counts["n_taken"]
        run.n_unusable = counts["n_unusable"]
        run._n_earlier = counts["n_earlier"]
        run.sequence = run.kept.opened()
        run.warnings.warn(
            f"the stream was interrupted after {len(run.steps)} frames, when its process was killed"
        )
        return run

    def stream(self) -> dict[str, Any]:
        """Name and policy of the stream, for ``after_a_kill``."""
        return {"stream": self.kept.name, "has_poses": self.kept.has_poses, "policy": self.policy}

    def constant_tensors(self) -> list[Tensor]:
        """Also the images of the kept frames."""
        frames = [*self.kept.kept_mapped.items, *self.kept.kept_held_out.items]
        return [
            *super().constant_tensors(),
            *(image for f in frames for image in (f.colour, f.depth_m)),
        ]

    def frames(self) -> "StreamRun":
        """The frames that come, without those held out: the run gives them itself."""
        return self

    @property
    def poses(self) -> list[Any]:
        """Camera-to-world pose [4, 4] of every frame of this run, as given, or as tracked and
        corrected so far."""
        return self.mapper.trajectory.poses[self._n_earlier :]

    def extra_metrics(self) -> dict[str, Any]:
        """Numbers of frames received, dropped and unusable, and the policy."""
        return {
            "n_frames_received": self._feed.n_received,
            "n_frames_dropped": self._feed.n_dropped,
            "n_frames_unusable": self.n_unusable,
            "policy": self.policy,
        }

    def __next__(self) -> Frame:
        """The next frame to map; held-out frames are stored and passed over."""
        data = self.mapper.config.data
        while True:
            if self.bad_in_a_row and self.until():
                self._note_the_end()
                raise StopIteration
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
            self.warnings.warn(f"{broke_off}; everything mapped before is kept")

    def _can_go_on(self, error: SequenceError) -> bool:
        return isinstance(error, BadFrameError)  # any other came from the source and ended it

    def _why_nothing(self) -> str:
        if not self.warnings:
            return f"no frame came from {self.sequence.name}"
        reason = (
            self.warnings[0]
            .removeprefix("skipped a frame: ")
            .removesuffix("; everything mapped before is kept")
        )
        return f"no frame of {self.sequence.name} could be mapped, the first because {reason}"


class KeptFrames:
    """A ``Sequence`` of some frames of a stream, by index, and of the poses of all mapped frames.

    Reading a frame that was not kept raises ``BadFrameError``. When there are more than ``most``
    frames, every other one is dropped, and from then on frames are kept half as often.
    """

    def __init__(self, name: str, *, has_poses: bool = True, most: int = MOST_VIEWS):
        self.name = name
        self.has_poses = has_poses
        self.camera = _UNKNOWN
        self.mapped: list[int] = []
        """Indices of all mapped frames."""
        self.kept_mapped = _EvenSample(most)
        self.kept_held_out = _EvenSample(most)
        self._last: Frame | None = None
        self._poses = array("f")

    def __len__(self) -> int:
        return 1 + max(
            (s.items[-1].index for s in (self.kept_mapped, self.kept_held_out) if s.items),
            default=-1,
        )

    def __getitem__(self, i: int) -> Frame:
        if self._last is not None and self._last.index == i:
            return self._last
        for sample in (self.kept_mapped, self.kept_held_out):
            for frame in sample.items:
                if frame.index == i:
                    return frame
        raise BadFrameError(f"frame {i} of {self.name} was not kept")

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i`` as given by the stream."""
        k = bisect.bisect_left(self.mapped, i)
        if k < len(self.mapped) and self.mapped[k] == i:
            return torch.tensor(self._poses[16 * k : 16 * k + 16]).reshape(4, 4)
        return self[i].T_WC

    def add(self, frame: Frame) -> None:
        """Record a frame that was mapped."""
        self.camera = frame.camera
        self.mapped.append(frame.index)
        self._poses.extend(frame.T_WC.flatten().tolist())
        self.kept_mapped.add(frame)
        self._last = frame

    def hold_out(self, frame: Frame) -> None:
        """Record a held-out frame: it is not mapped, so that the map can be scored with it."""
        self.kept_held_out.add(frame)

    def view(self, positions: list[int]) -> FrameSubset:
        """The frames with these indices."""
        return FrameSubset(source=self, positions=positions, camera=self.camera)

    def sample(self, limit: int) -> FrameSubset:
        """At most ``limit`` of the kept mapped frames, evenly spread; 0 means all."""
        indices = [frame.index for frame in self.kept_mapped.items]
        stride = max(1, -(-len(indices) // limit)) if limit else 1
        return self.view(indices[::stride])

    def covering(self, least: int) -> FrameSubset:
        """The mapped frames that were kept, at most ``least``: they are spread over the whole
        walk."""
        return self.sample(least)

    def state_dict(self) -> dict[str, Any]:
        """All kept frames and poses, as tensors and plain values."""
        samples = {"kept_mapped": self.kept_mapped, "kept_held_out": self.kept_held_out}
        return {name: sample.state_dict() for name, sample in samples.items()} | {
            "camera": vars(self.camera),
            "mapped": torch.tensor(self.mapped, dtype=torch.int64),
            "poses": torch.tensor(self._poses, dtype=torch.float32),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.camera = Camera(**state["camera"])
        self.mapped[:] = state["mapped"].tolist()
        self._poses = array("f", state["poses"].tolist())
        self.kept_mapped.load_state_dict(state["kept_mapped"])
        self.kept_held_out.load_state_dict(state["kept_held_out"])

    def opened(self) -> OpenedSequence:
        """All mapped frames, of which only some have images, and the held-out frames that were
        kept."""
        held_out = [frame.index for frame in self.kept_held_out.items]
        return OpenedSequence(
            source=self,
            positions=self.mapped,
            camera=self.camera,
            mapping=self.view(self.mapped),
            held_out=self.view(held_out),
        )


class _EvenSample:
    """At most ``most`` of the added frames, evenly spread."""

    def __init__(self, most: int):
        self.items: list[Frame] = []
        self._most = most
        self._step = 1
        self._n = 0

    def add(self, frame: Frame) -> None:
        if self._n % self._step == 0:
            if len(self.items) == self._most:
                self.items = self.items[::2]
                self._step *= 2
            if self._n % self._step == 0:
                self.items.append(frame)
        self._n += 1

    def state_dict(self) -> dict[str, Any]:
        return {
            "items": [frame.state_dict() for frame in self.items],
            "step": self._step,
            "n": self._n,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.items = [Frame.of_state(values) for values in state["items"]]
        self._step = state["step"]
        self._n = state["n"]
