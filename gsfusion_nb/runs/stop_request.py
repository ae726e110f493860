"""Stop a run with Ctrl-C or SIGTERM without losing data."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator


class StopRequest:
    """Turns Ctrl-C, an interrupt of the notebook kernel or SIGTERM into a request to stop after the current step.

    A second signal has no effect for ``PATIENCE_S`` seconds; after that, or if ``at_once`` is set, a signal raises
    ``KeyboardInterrupt`` immediately. While files are written (``saving``) it never does.
    """

    PATIENCE_S = 5.0

    def __init__(self):
        self.wanted = False
        self.at_once = False
        """True while stopping at any point loses no data, as when views are scored."""
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
        """A block that a signal ends immediately, because nothing is lost; the code after it runs as usual."""
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
        """A block that no signal interrupts, for writing files."""
        before, self.saving = self.saving, True
        try:
            yield
        finally:
            self.saving = before

    @contextlib.contextmanager
    def listening(self) -> Iterator["StopRequest"]:
        """Catch signals inside the block; does nothing outside the main thread, where that is not possible."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
