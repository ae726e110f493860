"""A frame is mapped as a whole or not at all, and by one caller at a time."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any, ClassVar


class HalfMappedError(RuntimeError):
    """A map contains only a part of a frame; it cannot map more frames, because the rest of that frame is lost."""


class FrameGuard:
    """Lets a mapper map one frame at a time, and remembers a frame that it could not finish.

    Everything that can fail because of the user's code or data comes before ``changes_begin``; if it fails, the map is
    unchanged. Later, only a failure of the machine (memory) or of the program can leave a frame half mapped; the map
    then refuses more frames.
    """

    def __init__(self):
        self.half_mapped = ""
        """Which frame was only half mapped, and why; empty if none was."""
        self._lock = threading.Lock()
        self._index, self._changing = -1, False

    @contextlib.contextmanager
    def one_frame(self, index: int) -> Iterator[None]:
        """Context for the step of a mapper on the frame with this index.

        After ``changes_begin``, Ctrl-C takes effect only when the frame is mapped.

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
            self._index, self._changing = index, False
            with DelayedInterrupt() as self._interrupt:
                try:
                    yield
                except BaseException as e:
                    if self._changing:
                        self.half_mapped = f"frame {index} was only half mapped ({type(e).__name__}: {e})"
                    raise
        finally:
            self._lock.release()

    def changes_begin(self) -> None:
        """Declare that the frame changes the map from here on."""
        self._interrupt.delay()
        self._changing = True

    @property
    def is_changing(self) -> bool:
        """Whether the frame has begun to change the map."""
        return self._changing


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

    def __exit__(self, *_: object) -> None:
        if DelayedInterrupt._outermost is not self:
            return
        DelayedInterrupt._outermost = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        for number, frame in self._pending:
            self._handlers[number](number, frame)
