"""Frames that arrive over time: their source, a thread that reads them ahead, and selecting
them."""

import abc
import contextvars
import dataclasses
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Literal

from ...checks import check_name
from ...config import DataConfig
from ...errors import BadFrameError, SequenceError
from ...types import Frame
from ..adjust.resize import resize_frame, resized_camera
from ..adjust.selection import within_depth
from ..sequence import Sequence

Policy = Literal["all", "latest"]

POLICIES: dict[Policy, str] = {
    "all": "every frame is mapped; the source waits while a few frames wait (files)",
    "latest": "only the newest frame waits; the one it replaces is dropped (cameras)",
}
"""What happens to frames that arrive faster than they are mapped."""


class LiveSource(abc.ABC):
    """Frames that arrive over time: iterate over it, from any thread; ``stop`` ends the iteration
    from another.

    A frame that cannot be used raises ``BadFrameError`` and the iteration can continue; other
    errors end it. A source that is interrupted (a camera that is unplugged) ends like a finished
    one, and ``broke_off`` says why.
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


log = logging.getLogger(__name__)

POLL_S = 0.1
"""Interval at which a waiting consumer checks whether to end, seconds."""
JOIN_S = 5.0
"""How long ``close`` waits for a source that does not return, seconds."""


class BackgroundFrames:
    """Frames of any iterable, read on a separate thread (itself an iterator; ``close`` it).

    For a frame that cannot be used its error is raised, and the iteration can continue. Any other
    exception of the source is raised here after the frames that came before it. The thread starts
    with the first ``next``.

    Args:
        frames: What to read. If it has a method ``stop``, it is called by ``close``.
        policy: Which frames are dropped when they arrive faster than they are taken, see
            ``POLICIES``.
        size: Frames that may wait with "all".
        until: Called while no frame is available; True ends the iteration.
        bad: Types of errors after which the source can continue.

    Raises:
        KeyError: unknown policy.
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
        check_name("policy", policy, POLICIES)
        self._waits = policy == "all"
        self._size = size if policy == "all" else 1
        self.n_received = 0
        """Frames that arrived, dropped ones included."""
        self.n_dropped = 0
        """Frames that were dropped."""
        self._source = frames
        self._until = until
        self._bad = bad
        self._waiting: deque[Frame | SequenceError] = deque()
        self._changed = threading.Condition()
        self._ended = self._closed = False
        self._error: BaseException | None = None
        # a new thread does not take over the chosen backend by itself
        context = contextvars.copy_context()
        self._thread = threading.Thread(
            target=context.run, args=(self._work,), name="frames", daemon=True
        )

    def __iter__(self) -> "BackgroundFrames":
        return self

    def __next__(self) -> Frame:
        if not self._thread.ident and not self._closed:
            self._thread.start()
        with self._changed:
            while not (self._waiting or self._ended or self._closed):
                if not self._changed.wait(POLL_S) and self._until():
                    raise StopIteration
            if self._closed:
                raise StopIteration
            if not self._waiting:
                error = self._error
                self._error = None
                raise StopIteration if error is None else error
            item = self._waiting.popleft()
            self._changed.notify_all()
        if isinstance(item, SequenceError):
            raise item
        return item

    def close(self) -> None:
        """End the thread and discard waiting frames. A source that does not return is abandoned."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        stop = getattr(self._source, "stop", None)
        if callable(stop):
            stop()
        if self._thread.ident and self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
            if self._thread.is_alive():
                log.warning(
                    "the source of frames did not end within %g s; its thread is abandoned", JOIN_S
                )

    def _work(self) -> None:
        error = None
        iterator = None
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
        with self._changed:
            self._ended = True
            self._error = error
            self._changed.notify_all()

    def _pass_on(self, frames: Iterator[Frame]) -> None:
        while not self._closed:
            try:
                item: Frame | SequenceError = next(frames)
            except StopIteration:
                return
            except self._bad as e:
                item = e
            with self._changed:
                if self._waits:
                    self._changed.wait_for(lambda: self._closed or len(self._waiting) < self._size)
                elif len(self._waiting) >= self._size:
                    self.n_dropped += isinstance(self._waiting.popleft(), Frame)
                self.n_received += isinstance(item, Frame)
                self._waiting.append(item)
                self._changed.notify_all()


class FramesInOrder:
    """The frames of a sequence from a position on; the iteration can continue after a frame that
    raises an error."""

    def __init__(self, sequence: Sequence, start: int = 0):
        self._sequence = sequence
        self._next = start

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


def read_ahead(
    sequence: Sequence, *, start: int = 0, depth: int = 4
) -> BackgroundFrames | FramesInOrder:
    """The frames of a sequence in order, decoded on another thread while earlier ones are in use.

    At most ``depth + 2`` frames are in memory: those that wait, the one being decoded and the one
    in use. ``close`` it if not all frames are taken.

    Args:
        sequence: Any sequence whose frames may be read from another thread.
        start: First position.
        depth: Frames that may wait; 0 decodes each frame when it is asked for, on the caller's
            thread.
    """
    frames = FramesInOrder(sequence, start)
    return BackgroundFrames(frames, size=depth, bad=SequenceError) if depth else frames


class SelectedFrames:
    """Frames of a stream, numbered by arrival, selected, resized and with depth limits (an
    iterator).

    ``start``, ``stop`` and ``stride`` count arrivals, unusable frames included; ``hold_out_every``
    is the mapper's.

    Raises:
        SequenceError: ``data.repair`` asks for corrections, which are possible only for recordings.
    """

    def __init__(
        self,
        frames: Iterable[Frame] | Sequence,
        data: DataConfig,
        *,
        name: str = "stream",
        first_index: int = 0,
    ):
        if data.repair.changes.keys() - {"depth_pose"}:  # a stream's images have one time
            raise SequenceError(
                f"{name}: data.repair corrects recordings; a stream cannot be corrected"
            )
        if 0 < data.stop <= data.start:
            raise SequenceError(
                f"{name}: data.stop must be above data.start {data.start}, or 0, got {data.stop}"
            )
        self._source = frames
        self._data = data
        self._name = name
        self._first_index = first_index
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
        frame = resize_frame(
            frame, resized_camera(frame.camera, self._data.width, self._data.height)
        )
        frame = dataclasses.replace(frame, index=self._first_index + position)
        return within_depth(frame, self._data.depth_min_m, self._data.depth_max_m, name=self._name)
