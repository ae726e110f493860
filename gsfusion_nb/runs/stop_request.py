"""Ending a run by Ctrl-C or SIGTERM without losing anything."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator


class StopRequest:
    """Turns Ctrl-C, a kernel interrupt or SIGTERM into a wish that is granted between two steps.

    Pressing again changes nothing for ``PATIENCE_S`` seconds; after that, or where ``at_once`` is set, the signal
    raises ``KeyboardInterrupt`` on the spot. While files are written (``saving``) it never does.
    """

    PATIENCE_S = 5.0

    def __init__(self):
        self.wanted = False
        self.at_once = False
        """Set where stopping in the middle loses nothing: while views are scored."""
        self.saving = False
        self._since = 0.0

    def __bool__(self) -> bool:
        return self.wanted

    def _handle(self, signum, frame) -> None:
        first, self.wanted = not self.wanted, True
        if first:
            self._since = time.monotonic()
        if self.saving:
            return
        if self.at_once or (not first and time.monotonic() - self._since > self.PATIENCE_S):
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def ending_at_once(self) -> Iterator[None]:
        """A block in which stopping loses nothing: a signal ends it on the spot, and what follows it goes on."""
        self.at_once = True
        try:
            if not self.wanted:
                yield
        except KeyboardInterrupt:
            if not self.wanted:
                raise
        finally:
            self.at_once = False

    @contextlib.contextmanager
    def held_back(self) -> Iterator[None]:
        """A block that writes files: no signal ends it."""
        before, self.saving = self.saving, True
        try:
            yield
        finally:
            self.saving = before

    @contextlib.contextmanager
    def listening(self) -> Iterator["StopRequest"]:
        """Listen inside the block; does nothing outside the main thread, where signals cannot be caught."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
