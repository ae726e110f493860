"""The settings of ``DataConfig`` applied to frames as they arrive."""

import dataclasses
from collections.abc import Iterable, Iterator

from ...config import DataConfig
from ...types import Frame
from ..adjust.resize import resize_frame
from ..adjust.select import resized_camera, within_depth
from ..sequence import BadFrameError, Sequence, SequenceError
from .background_frames import FramesInOrder


class SelectedFrames:
    """Frames of a stream, numbered by arrival, selected, resized and with depth limits (an iterator).

    ``start``, ``stop`` and ``stride`` count arrivals, unusable frames included; ``hold_out_every`` is the mapper's.

    Raises:
        SequenceError: ``data.repair`` asks for corrections, which are possible only for recordings.
    """

    def __init__(
        self, frames: Iterable[Frame] | Sequence, data: DataConfig, *, name: str = "stream", first_index: int = 0
    ):
        if data.repair.changes:
            raise SequenceError(f"{name}: data.repair corrects recordings; a stream cannot be corrected")
        if 0 < data.stop <= data.start:
            raise SequenceError(f"{name}: data.stop must be above data.start {data.start}, or 0, got {data.stop}")
        self._source, self._data, self._name, self._first_index = frames, data, name, first_index
        self._frames: Iterator[Frame] | None = None
        self._arrived = 0

    def __iter__(self) -> "SelectedFrames":
        return self

    def __next__(self) -> Frame:
        if self._frames is None:
            source = self._source
            self._frames = FramesInOrder(source) if isinstance(source, Sequence) else iter(source)
        data = self._data
        while not data.stop or self._arrived < data.stop:
            position = self._arrived
            try:
                frame = next(self._frames)
            except BadFrameError:
                self._arrived += 1
                raise
            self._arrived += 1
            if not isinstance(frame, Frame):
                raise SequenceError(f"{self._name}: expected a Frame, got {type(frame).__name__}")
            if position >= data.start and (position - data.start) % data.stride == 0:
                return self._prepared(frame, position)
        raise StopIteration

    def stop(self) -> None:
        """Ask the source to end."""
        if callable(stop := getattr(self._source, "stop", None)):
            stop()

    def close(self) -> None:
        """End the source's iterator, on the thread that used it."""
        if callable(close := getattr(self._frames, "close", None)):
            close()

    def _prepared(self, frame: Frame, position: int) -> Frame:
        frame = resize_frame(frame, resized_camera(frame.camera, self._data))
        frame = dataclasses.replace(frame, index=self._first_index + position)
        return within_depth(frame, self._data.depth_min_m, self._data.depth_max_m, name=self._name)
