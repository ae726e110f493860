"""The frames of a stream that are kept for scoring and display: a limited number, evenly spread, and all poses."""

import bisect
import dataclasses
from array import array
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import OpenedSequence, SequenceView
from ..errors import BadFrameError
from ..types import Camera, Frame

MOST_VIEWS = 24
"""At most this many mapped frames are kept, and as many held-out ones: 2.1 MB each at 640x480."""

_UNKNOWN = Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5)


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

    def state_dict(self) -> dict[str, Any]:
        return {"items": [_frame_state(frame) for frame in self.items], "step": self._step, "n": self._n}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.items = [Frame(**{**f, "camera": Camera(**f["camera"])}) for f in state["items"]]
        self._step, self._n = state["step"], state["n"]


def _frame_state(frame: Frame) -> dict[str, Any]:
    return {f.name: getattr(frame, f.name) for f in dataclasses.fields(frame)} | {"camera": vars(frame.camera)}
