"""A frame is mapped as a whole or not at all, and by one caller at a time."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any, ClassVar


class HalfMappedError(RuntimeError):
    """A map contains only a part of a frame; it cannot map more frames, because the rest of that frame is lost."""


class FrameUndone(KeyboardInterrupt):
    """A frame was undone because the program is asked to stop; the map is as before it."""


class FrameGuard:
    """Lets a mapper map one frame at a time, and remembers a frame that it could not finish.

    What can fail because of the user's code or data comes before ``changes_begin``; if it fails, the map is unchanged.
    From there until ``changes_stay`` a frame can be undone, if the mapper has given a function for it. Otherwise only a
    failure of the machine (memory) or of the program can leave a frame half mapped; the map then refuses more frames.
    """

    def __init__(self):
        self.stop_wanted: Callable[[], bool] = lambda: False
        """Whether the program is asked to stop; a frame that can be undone is then given up. A run sets it."""
        self.half_mapped = ""
        """Which frame was only half mapped, and why; empty if none was."""
        self._lock = threading.Lock()
        self._index, self._changing = -1, False
        self._undo: Callable[[], None] | None = None

    @contextlib.contextmanager
    def one_frame(self, index: int) -> Iterator[None]:
        """Context for the step of a mapper on the frame with this index.

        After ``changes_begin``, Ctrl-C takes effect only when the frame is mapped, or at ``may_stop``.

        Raises:
            RuntimeError: another thread is in a step. HalfMappedError: an earlier frame was only half mapped.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                f"frame {index} was given while another thread maps frame {self._index}; give one frame at a time"
            )
        try:
            if self.half_mapped:
                raise HalfMappedError(
                    f"{self.half_mapped}; this map takes no more frames: continue from the run's last checkpoint "
                    "(resume_mapping), or with a new mapper"
                )
            self._index, self._changing, self._undo = index, False, None
            with DelayedInterrupt() as self._interrupt:
                try:
                    yield
                except BaseException as e:
                    if self._changing:
                        self.half_mapped = f"frame {index} was only half mapped ({type(e).__name__}: {e})"
                    raise
        finally:
            self._undo = None
            self._lock.release()

    def changes_begin(self, undo: Callable[[], None] | None = None) -> None:
        """Declare that the frame changes the map from here on; ``undo`` would bring back the map of now."""
        self._interrupt.delay()
        self._changing, self._undo = True, undo

    def may_stop(self) -> None:
        """Called between two gradient steps. If the frame can be undone, Ctrl-C and SIGTERM take effect here.

        Raises:
            FrameUndone: the program is asked to stop. KeyboardInterrupt: Ctrl-C, where nobody else handles it.
        """
        if self._undo is None:
            return
        self._interrupt.deliver()
        if self.stop_wanted():
            raise FrameUndone

    def changes_stay(self) -> None:
        """Declare that what follows cannot be undone."""
        self._undo = None

    @property
    def can_undo(self) -> bool:
        """Whether what the frame has changed can be undone."""
        return self._undo is not None

    def undo(self) -> bool:
        """Undo what the frame has changed; returns whether the map is now as it was before the frame."""
        if self._undo is not None:
            self._undo()
            self._changing = False
        return not self._changing


class DelayedInterrupt:
    """Context manager: after ``delay``, Ctrl-C and SIGTERM are delivered only when the block ends.

    Of nested blocks, the outermost delivers them. It does nothing outside the main thread, where no signal arrives, nor
    for signals that Python does not handle.
    """

    _outermost: "ClassVar[DelayedInterrupt | None]" = None

    def __init__(self):
        self._handlers: dict[int, Any] = {}
        self._pending: list[tuple[int, Any]] = []

    def __enter__(self) -> "DelayedInterrupt":
        if threading.current_thread() is threading.main_thread() and DelayedInterrupt._outermost is None:
            DelayedInterrupt._outermost = self
        return self

    def delay(self) -> None:
        """Delay signals from now on."""
        outer = DelayedInterrupt._outermost
        if outer is None or outer._handlers or threading.current_thread() is not threading.main_thread():
            return
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(signal.getsignal(number)):
                outer._handlers[number] = signal.signal(number, lambda *signal_: outer._pending.append(signal_))

    def deliver(self) -> None:
        """Deliver the signals that have come so far, in the block; those that come later wait again."""
        outer = DelayedInterrupt._outermost
        if outer is None or threading.current_thread() is not threading.main_thread():
            return
        while outer._pending:
            number, frame = outer._pending.pop(0)
            outer._handlers[number](number, frame)

    def __exit__(self, *_: object) -> None:
        if DelayedInterrupt._outermost is not self:
            return
        DelayedInterrupt._outermost = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        for number, frame in self._pending:
            self._handlers[number](number, frame)
