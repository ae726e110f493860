"""A thread that reads frames while earlier ones are being mapped, with a limit on the number that wait."""

import contextvars
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ...types import Frame
from ..sequence import BadFrameError, Sequence, SequenceError
from .frame_queue import FrameQueue

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
