"""Ctrl-C and SIGTERM: where they take effect at once, and where they wait until a change is
whole."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import CodeType, FrameType, TracebackType
from typing import Any, ClassVar, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_UNDISTURBED: set[CodeType] = set()
"""Code in which no signal takes effect: it clears up after an error."""


def undisturbed(function: F) -> F:
    """Mark a function that clears up: inside a ``DelayedInterrupt`` no signal ends it halfway, from
    its first line on.

    A ``try: ... finally:`` alone does not promise that, because a signal may arrive between the
    error and what the block does first.
    """
    _UNDISTURBED.add(function.__code__)
    return function


while_compiling: list[Callable[[], None]] = []
"""Called, the last of them, while a compiler works: it may raise ``KeyboardInterrupt``, so that
nobody waits for the compiler, which takes up to a minute. Whoever delays signals puts a function
here that knows whether that is possible."""


def compiler_goes_on() -> None:
    """Called again and again by those who wait for a compiler."""
    if while_compiling and _is_main_thread():
        while_compiling[-1]()


not_waited_for: list[threading.Thread] = []
"""Threads in a compiler, which nothing can stop, and which a program that was interrupted does not
wait for."""


def end_process(status: int) -> None:
    """End the process at once if it would wait for such a thread; otherwise nothing happens. What
    was printed is written out."""
    if not_waited_for:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def as_interrupt(error: BaseException) -> KeyboardInterrupt | None:
    """The ``KeyboardInterrupt`` that an error hides; None if it hides none.

    Python makes a ``SystemError`` of it where a signal arrives in compiled code that is about to
    return a value.
    """
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause


class DelayedInterrupt:
    """Context manager in which Ctrl-C and SIGTERM wait until the block ends, or until ``allow`` or
    ``deliver``.

    Of nested blocks, the outermost delivers them. It does nothing outside the main thread, where no
    signal arrives, nor for signals that Python does not handle. After a signal has raised
    ``KeyboardInterrupt`` in the block, further ones wait, so that what clears up after the first is
    not interrupted by the second.
    """

    _outermost: "ClassVar[DelayedInterrupt | None]" = None

    def __init__(self):
        self._handlers: dict[int, Any] = {}
        self._pending: list[tuple[int, FrameType | None]] = []
        self._waits = True

    @undisturbed
    def __enter__(self) -> "DelayedInterrupt":
        if not _is_main_thread() or DelayedInterrupt._outermost is not None:
            return self
        for number in (signal.SIGTERM, signal.SIGINT):
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._handle)
        DelayedInterrupt._outermost = self
        return self

    @undisturbed
    def __exit__(self, *_: object) -> None:
        if DelayedInterrupt._outermost is not self:
            return
        DelayedInterrupt._outermost = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        while self._pending:
            self._deliver_next()

    @staticmethod
    def delay() -> None:
        """Signals wait from now on."""
        outer = DelayedInterrupt._outermost
        if outer is not None and _is_main_thread():
            outer._waits = True

    @staticmethod
    def allow() -> None:
        """Signals take effect at once from now on, and so do those that have come."""
        outer = DelayedInterrupt._outermost
        if outer is not None and _is_main_thread():
            outer._waits = False
            DelayedInterrupt.deliver()

    @staticmethod
    def deliver() -> None:
        """Deliver the signals that have come so far, in the block; whether later ones wait does not
        change."""
        outer = DelayedInterrupt._outermost
        while outer is not None and _is_main_thread() and outer._pending:
            outer._deliver_next()

    def _deliver_next(self) -> None:
        self._call(*self._pending.pop(0))

    def _handle(self, number: int, frame: FrameType | None) -> None:
        waits = self._waits and DelayedInterrupt._outermost is self
        if waits or _is_undisturbed(frame):
            self._pending.append((number, frame))
        else:
            self._call(number, frame)

    def _call(self, number: int, frame: FrameType | None) -> None:
        waits = self._waits
        self._waits = True
        self._handlers[number](number, frame)
        self._waits = waits  # the handler has not raised


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_undisturbed(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code in _UNDISTURBED:
            return True
        frame = frame.f_back
    return False


_COMMAND = "gsfusion-nb"


def _say_interrupted(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Of Ctrl-C while the command imports what it needs, which takes seconds, say one line and no
    traceback."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write(f"{_COMMAND}: interrupted\n")
    else:
        sys.__excepthook__(kind, error, trace)


if os.path.splitext(os.path.basename(sys.argv[0] if sys.argv else ""))[0] == _COMMAND:
    sys.excepthook = _say_interrupted
