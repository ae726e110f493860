"""One run over frames that arrive over time, of which only a few are kept."""

import bisect
from array import array
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import BadFrameError, OpenedSequence, Sequence, SequenceError, SequenceView
from ..data.stream import BackgroundFrames, Policy, SelectedFrames
from ..mapping import Mapper
from ..mapping.step import check_frame
from ..mapping.training import KeyframePasses
from ..types import Camera, Frame
from .mapping_run import MappingRun

MOST_VIEWS = 24
"""At most this many mapped frames are kept, and as many held-out ones: 2.1 MB each at 640x480."""

_UNKNOWN = Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5)


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
        self._feed = BackgroundFrames(selected, policy=self.policy, until=lambda: self.until())
        self._n_taken = self.n_unusable = 0
        self._holds_out = data.hold_out_every > 0 and (self.kept.has_poses or not self.mapper.localiser.is_tracking)
        self._n_earlier = len(earlier)
        self.mapper.passes = KeyframePasses()

    def frames(self) -> "StreamRun":
        """The frames that come, without those held out: the run gives them itself."""
        return self

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
            "n_frames_received": self._feed.n_received,
            "n_frames_dropped": self._feed.n_dropped,
            "n_frames_unusable": self.n_unusable,
            "policy": self.policy,
        }

    def __next__(self) -> Frame:
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


class KeptFrames:
    """A ``Sequence`` of some frames of a stream, by index, and of the poses of all mapped frames.

    Reading a frame that was not kept raises ``BadFrameError``. When there are more than ``most`` frames, every other
    one is dropped, and from then on frames are kept half as often.
    """

    def __init__(self, name: str, *, has_poses: bool = True, most: int = MOST_VIEWS):
        self.name, self.has_poses, self.camera = name, has_poses, _UNKNOWN
        self.mapped: list[int] = []
        """Indices of all mapped frames."""
        self.kept_mapped = _EvenSample(most)
        self.kept_held_out = _EvenSample(most)
        self._last: Frame | None = None
        self._poses = array("f")

    def __len__(self) -> int:
        return 1 + max((s.items[-1].index for s in (self.kept_mapped, self.kept_held_out) if s.items), default=-1)

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

    def view(self, positions: list[int]) -> SequenceView:
        """The frames with these indices."""
        return SequenceView(source=self, positions=positions, camera=self.camera)

    def opened(self) -> OpenedSequence:
        """All mapped frames, of which only some have images, and the held-out frames that were kept."""
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
        self._most, self._step, self._n = most, 1, 0

    def add(self, frame: Frame) -> None:
        if self._n % self._step == 0:
            if len(self.items) == self._most:
                self.items = self.items[::2]
                self._step *= 2
            if self._n % self._step == 0:
                self.items.append(frame)
        self._n += 1
