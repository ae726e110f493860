"""Frames that arrive over time: their source, a thread that reads them ahead, the queue between, and selecting them."""

import abc
import contextvars
import dataclasses
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

from ...checks import check_name
from ...config import DataConfig
from ...types import Frame
from ..adjust.repair import resized_camera, within_depth
from ..adjust.resize import resize_frame
from ..sequence import BadFrameError, Sequence, SequenceError

Policy = Literal["all", "queue", "latest", "drop"]

POLICIES: dict[Policy, str] = {
    "all": "every frame is mapped; the source waits while the queue is full (files)",
    "queue": "a full queue drops its oldest frame; the source never waits",
    "latest": "only the newest frame waits; the one it replaces is dropped",
    "drop": "a frame that arrives while another is being mapped or waits is dropped",
}
"""What happens to frames that arrive faster than they are mapped."""


class LiveSource(abc.ABC):
    """Frames that arrive over time: iterate over it, from any thread; ``stop`` ends the iteration from another.

    A frame that cannot be used raises ``BadFrameError`` and the iteration can continue; other errors end it. A source
    that is interrupted (a camera that is unplugged) ends like a finished one, and ``broke_off`` says why.
    """

    name: str = "stream"
    has_poses: bool = False
    """False: every pose is the identity, and the mapper must track."""
    policy: Policy = "latest"
    """Default policy for frames that arrive faster than they are mapped."""
    broke_off: str = ""
    """Why the source ended too early, as a sentence; empty if it did not."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[Frame]: ...

    @abc.abstractmethod
    def stop(self) -> None:
        """End the iteration after the frame that is being read."""


MAX_ERRORS = 64
"""Largest number of waiting errors of unusable frames; the policy does not apply to them."""


class FrameQueue:
    """Passes frames from one thread to another, in order; holds at most ``size`` of them.

    Args:
        policy: Which frames are dropped when they arrive faster than they are taken, see ``POLICIES``.
        size: Frames that may wait, for "all" and "queue"; with "latest" and "drop" it is one.

    Raises:
        KeyError: unknown policy. ValueError: ``size`` is below 1.
    """

    def __init__(self, policy: str = "all", size: int = 4):
        check_name("policy", policy, POLICIES)
        if size < 1:
            raise ValueError(f"the queue must hold at least 1 frame, got {size}")
        self.policy = policy
        self.size = size if policy in ("all", "queue") else 1
        self.n_received = 0
        """Frames that arrived, dropped ones included."""
        self.n_dropped = 0
        """Frames that were dropped."""
        self._frames: deque[Frame | SequenceError] = deque()
        self._n_waiting = 0
        self._changed = threading.Condition()
        self._busy = False
        self._ended = False
        self._closed = False
        self._error: BaseException | None = None

    @property
    def closed(self) -> bool:
        """Whether the consumer has closed the queue, so that no more frames are needed."""
        return self._closed

    @property
    def n_waiting(self) -> int:
        """Frames that wait now."""
        return self._n_waiting

    def put(self, frame: Frame) -> None:
        """Add a frame; with "all" this waits for room, unless the queue is closed."""
        with self._changed:
            if self.policy == "all":
                self._changed.wait_for(lambda: self._closed or self._n_waiting < self.size)
            if self._closed:
                return
            self.n_received += 1
            if self._n_waiting >= self.size or (self.policy == "drop" and self._busy):
                self.n_dropped += 1
                if self.policy == "drop":
                    return
                self._drop_oldest()
            self._frames.append(frame)
            self._n_waiting += 1
            self._changed.notify_all()

    def put_error(self, error: SequenceError) -> None:
        """Add the error of a frame that cannot be used; ``get`` raises it in order, and it is never dropped."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or len(self._frames) - self._n_waiting < MAX_ERRORS)
            self._frames.append(error)
            self._changed.notify_all()

    def end(self, error: BaseException | None = None) -> None:
        """Declare the end; ``error`` is raised after the last frame was taken."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def get(self, timeout_s: float | int | None = None) -> Frame | None:
        """The next frame, or None if none came within ``timeout_s``.

        Raises:
            StopIteration: the source has ended. SequenceError: the next frame cannot be used. BaseException: the error
                that ended the source.
        """
        with self._changed:
            self._busy = False
            self._changed.wait_for(lambda: self._frames or self._ended or self._closed, timeout_s)
            if self._closed:
                raise StopIteration
            if self._frames:
                item = self._frames.popleft()
                self._n_waiting -= isinstance(item, Frame)
                self._busy = isinstance(item, Frame)
                self._changed.notify_all()
                if isinstance(item, SequenceError):
                    raise item
                return item
            if not self._ended:
                return None
            error, self._error = self._error, None
            raise StopIteration if error is None else error

    def close(self) -> None:
        """Close the queue: waiting frames are discarded, and a producer that waits for room continues."""
        with self._changed:
            self._closed = True
            self._frames.clear()
            self._n_waiting = 0
            self._changed.notify_all()

    def _drop_oldest(self) -> None:
        oldest = next(i for i, item in enumerate(self._frames) if isinstance(item, Frame))
        del self._frames[oldest]
        self._n_waiting -= 1


log = logging.getLogger(__name__)

POLL_S = 0.1
"""Interval at which a waiting consumer checks whether to end, seconds."""
JOIN_S = 5.0
"""How long ``close`` waits for a source that does not return, seconds."""


class BackgroundFrames:
    """Frames of any iterable, read on a separate thread (itself an iterator, and a context manager).

    For a frame that cannot be used its error is raised, and the iteration can continue. Any other exception of the
    source is raised here after the frames that came before it. The thread starts with the first ``next``.

    Args:
        frames: What to read. If it has a method ``stop``, it is called by ``close``.
        policy: Which frames are dropped when they arrive faster than they are taken, see ``POLICIES``.
        size: Frames that may wait.
        until: Called while no frame is available; True ends the iteration.
        bad: Types of errors after which the source can continue.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        *,
        policy: str = "all",
        size: int = 4,
        until: Callable[[], bool] = lambda: False,
        bad: type[SequenceError] = BadFrameError,
    ):
        self.queue = FrameQueue(policy, size)
        self._source, self._until, self._bad = frames, until, bad
        context = contextvars.copy_context()  # a new thread does not take over the chosen backend by itself
        self._thread = threading.Thread(target=context.run, args=(self._work,), name="frames", daemon=True)

    def __enter__(self) -> "BackgroundFrames":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __iter__(self) -> "BackgroundFrames":
        return self

    def __next__(self) -> Frame:
        if not self._thread.ident and not self.queue.closed:
            self._thread.start()
        while (frame := self.queue.get(POLL_S)) is None:
            if self._until():
                raise StopIteration
        return frame

    def close(self) -> None:
        """End the thread and discard waiting frames. A source that does not return is abandoned."""
        self.queue.close()
        stop = getattr(self._source, "stop", None)
        if callable(stop):
            stop()
        if self._thread.ident and self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
            if self._thread.is_alive():
                log.warning("the source of frames did not end within %g s; its thread is abandoned", JOIN_S)

    def _work(self) -> None:
        error, iterator = None, None
        try:
            iterator = iter(self._source)
            self._pass_on(iterator)
        except BaseException as e:
            error = e
        try:
            if callable(close := getattr(iterator, "close", None)):
                close()
        except Exception as e:
            error = error or e
        self.queue.end(error)

    def _pass_on(self, frames: Iterator[Frame]) -> None:
        while not self.queue.closed:
            try:
                self.queue.put(next(frames))
            except StopIteration:
                return
            except self._bad as e:
                self.queue.put_error(e)


class FramesInOrder:
    """The frames of a sequence from a position on; the iteration can continue after a frame that raises an error."""

    def __init__(self, sequence: Sequence, start: int = 0):
        self._sequence, self._next = sequence, start

    def __enter__(self) -> "FramesInOrder":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __iter__(self) -> "FramesInOrder":
        return self

    def __next__(self) -> Frame:
        if self._next >= len(self._sequence):
            raise StopIteration
        self._next += 1
        return self._sequence[self._next - 1]

    def close(self) -> None:
        """Read no more."""
        self._next = len(self._sequence)


def read_ahead(sequence: Sequence, *, start: int = 0, depth: int = 4) -> BackgroundFrames | FramesInOrder:
    """The frames of a sequence in order, decoded on another thread while earlier ones are in use.

    At most ``depth + 2`` frames are in memory: those that wait, the one being decoded and the one in use. ``close`` it
    if not all frames are taken.

    Args:
        sequence: Any sequence whose frames may be read from another thread.
        start: First position.
        depth: Frames that may wait; 0 decodes each frame when it is asked for, on the caller's thread.
    """
    frames = FramesInOrder(sequence, start)
    return BackgroundFrames(frames, size=depth, bad=SequenceError) if depth else frames


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
