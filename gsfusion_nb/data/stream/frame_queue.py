"""The queue between the thread that reads frames and the one that maps them, and which frames it drops when full."""

import threading
from collections import deque
from typing import Literal

from ...checks import check_name
from ...types import Frame
from ..sequence import SequenceError

Policy = Literal["all", "queue", "latest", "drop"]

POLICIES: dict[Policy, str] = {
    "all": "every frame is mapped; the source waits while the queue is full (files)",
    "queue": "a full queue drops its oldest frame; the source never waits",
    "latest": "only the newest frame waits; the one it replaces is dropped",
    "drop": "a frame that arrives while another is being mapped or waits is dropped",
}
"""What happens to frames that arrive faster than they are mapped."""

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
