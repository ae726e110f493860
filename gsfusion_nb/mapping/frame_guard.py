"""One frame at a time, and what becomes of a frame that is interrupted or fails."""

import contextlib
import threading
from collections.abc import Callable, Iterator

from ..errors import ForeseenError
from ..interrupts import DelayedInterrupt, undisturbed, while_compiling


class HalfMappedError(ForeseenError, RuntimeError):
    """A map contains only a part of a frame; it cannot map more frames, because the rest of that
    frame is lost."""


class FrameUndone(KeyboardInterrupt):
    """A frame was undone because the program is asked to stop; the map is as before it."""


class FrameGuard:
    """Lets a mapper map one frame at a time, and remembers a frame that it could not finish.

    What can fail because of the user's code or data comes before ``changes_begin``; if it fails,
    the map is unchanged. From there until ``changes_stay`` a frame can be undone, if the mapper has
    given a function for it. Otherwise only a failure of the machine (memory) or of the program can
    leave a frame half mapped; the map then refuses more frames.
    """

    def __init__(self):
        self.stop_wanted: Callable[[], bool] = lambda: False
        """Whether the program is asked to stop; a frame that can be undone is then given up. A run
        sets it."""
        self.end_wanted: Callable[[], bool] = lambda: False
        """Likewise, also where nothing is mapped yet; asked while kernels are compiled."""
        self.half_mapped = ""
        """Which frame was only half mapped, and why; empty if none was."""
        self._lock = threading.Lock()
        self._index = -1
        self._changing = False
        self._undo: Callable[[], None] | None = None

    @contextlib.contextmanager
    def while_mapping(self, index: int) -> Iterator[None]:
        """Context for the step of a mapper on the frame with this index.

        After ``changes_begin``, Ctrl-C takes effect only when the frame is mapped, or at
        ``may_stop``.

        Raises:
            RuntimeError: another thread is in a step. HalfMappedError: an earlier frame was only
                half mapped.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                f"frame {index} was given while another thread maps frame {self._index}; give one "
                "frame at a time"
            )
        try:
            if self.half_mapped:
                raise HalfMappedError(
                    f"{self.half_mapped}; this map takes no more frames: continue from the run's "
                    "last checkpoint (resume_mapping), or with a new mapper"
                )
            self._index = index
            self._changing = False
            self._undo = None
            with DelayedInterrupt() as interrupt:
                interrupt.allow()
                try:
                    with self._heard_while_compiling():
                        yield
                except BaseException as e:
                    if self._changing:
                        self.half_mapped = (
                            f"frame {index} was only half mapped ({type(e).__name__}: {e})"
                        )
                    raise
        finally:
            self._undo = None
            self._lock.release()

    def check_idle(self, purpose: str) -> None:
        """Raise ``RuntimeError`` while a frame is being mapped, which changes the map; ``purpose``
        ends the sentence."""
        if self._lock.locked():
            raise RuntimeError(
                f"frame {self._index} is being mapped; wait for its end before {purpose}"
            )

    @contextlib.contextmanager
    def while_optimising(self, undo: Callable[[], None]) -> Iterator[None]:
        """Context for a step after the scan; if it fails, ``undo`` brings back the map before it.

        Ctrl-C takes effect after the step, or at ``may_stop``.
        """
        with DelayedInterrupt():
            self.changes_begin(undo)
            try:
                with self._heard_while_compiling():
                    yield
            except BaseException:
                self.undo()
                raise
            finally:
                self._changing = False
                self._undo = None

    @contextlib.contextmanager
    def _heard_while_compiling(self) -> Iterator[None]:
        """Context in which Ctrl-C ends the compilation of a kernel, if what was changed by then can
        be undone."""

        def may_end() -> None:
            if self._changing and self._undo is None:
                return
            DelayedInterrupt.deliver()
            if self.stop_wanted():
                raise FrameUndone
            if self.end_wanted():
                raise KeyboardInterrupt

        while_compiling.append(may_end)
        try:
            yield
        finally:
            while_compiling.remove(may_end)

    def changes_begin(self, undo: Callable[[], None] | None = None) -> None:
        """Declare that the frame changes the map from here on; ``undo`` would bring back the map of
        now."""
        DelayedInterrupt.delay()
        self._changing = True
        self._undo = undo

    def may_stop(self) -> None:
        """Called between two gradient steps. If the frame can be undone, Ctrl-C and SIGTERM take
        effect here.

        Raises:
            FrameUndone: the program is asked to stop. KeyboardInterrupt: Ctrl-C, where nobody else
                handles it.
        """
        if self._undo is None:
            return
        DelayedInterrupt.deliver()
        if self.stop_wanted():
            raise FrameUndone

    def changes_stay(self) -> None:
        """Declare that what follows cannot be undone."""
        self._undo = None

    @undisturbed
    def undo(self) -> bool:
        """Undo what the frame has changed; returns whether the map is now as it was before the
        frame."""
        DelayedInterrupt.delay()
        if self._undo is not None:
            self._undo()
            self._changing = False
        return not self._changing
