"""A thread that runs an iterator and can be paused, stepped and stopped while other cells run."""

import contextvars
import html
import logging
import math
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch

log = logging.getLogger(__name__)

MIN_INTERVAL_S = 0.1
"""What is shown of the work is renewed at most ten times a second."""
WAITING = object()
"""What ``make_steps()`` may yield while a step waits for something: no step is counted, and the
work can be paused or stopped there."""
State = Literal["ready", "running", "paused", "stopped", "finished", "failed"]


class Player:
    """Runs the iterator that ``make_steps()`` returns in a thread of its own.

    Widgets and tests use the same methods: ``start``, ``pause``, ``step``, ``stop``, ``join``;
    ``run_sync`` does the work in the calling thread. ``lock`` is held during a step: hold it too
    when reading what the steps change.

    Args:
        make_steps: Makes the iterator. It is called again after a stop or an error and must then
            continue from the current state, not start again.
        on_step: Called after each step with what the iterator yielded, in the thread of the step,
            with the lock held.
        on_rest: Called with the lock held when the work has paused, stopped, finished or failed.
        on_wait: Called with the lock held each time that the iterator yielded ``WAITING``.

    An exception ends the work: ``state`` is "failed" and ``error`` holds the exception. It is not
    printed, because the output of a thread may appear under any cell.
    """

    def __init__(
        self,
        make_steps: Callable[[], Iterator[Any]],
        *,
        on_step: Callable[[Any], None] = lambda _: None,
        on_rest: Callable[[], None] = lambda: None,
        on_wait: Callable[[], None] = lambda: None,
    ):
        self._make_steps = make_steps
        self._on_step = on_step
        self._on_rest = on_rest
        self._on_wait = on_wait
        self._steps: Iterator[Any] | None = None
        self.lock = threading.RLock()
        self.on_state: Callable[[], None] = lambda: None
        """Called after each change of ``state`` and each request, from any thread."""
        self._state: State = "ready"
        self.error: BaseException | None = None
        self.n_steps = 0
        """Steps done."""
        self._asking = threading.Lock()
        self._steps_left = 0.0
        """Steps still to do, perhaps infinitely many; changes, as the two below, only while
        ``_asking`` is held."""
        self._next_state: State = "paused"
        self._serving = False
        """The thread is running and will read new requests."""
        self._thread: threading.Thread | None = None

    @property
    def state(self) -> State:
        """What it does now."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        self._state = state
        self.on_state()

    @property
    def keeps_running(self) -> bool:
        """Whether it runs, or is about to, until it is paused or stopped."""
        return self._steps_left == math.inf and self._state not in ("finished", "failed")

    @property
    def is_alive(self) -> bool:
        """Whether the worker thread exists."""
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> None:
        """Run until paused, stopped or finished."""
        self._ask(math.inf)

    def pause(self) -> None:
        """Pause after the current step."""
        self._ask(0)

    def step(self) -> None:
        """Do one step, then pause."""
        self._ask(1)

    def stop(self) -> None:
        """Stop after the current step. ``start`` continues from there."""
        self._ask(0, "stopped")

    def close(self, timeout_s: float | int = 30.0) -> None:
        """Stop, and wait until the thread has ended."""
        self.stop()
        self.join(timeout_s)

    def join(self, timeout_s: float | int | None = None) -> bool:
        """Wait until the thread has ended, as it does at each pause. Returns whether it has."""
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout_s)
        return not self.is_alive

    def run_sync(self, n: int | None = None) -> int:
        """Do ``n`` steps, or all that are left, in the calling thread. Returns how many.

        A worker thread is stopped first.

        Raises:
            Exception: whatever a step raised.
        """
        self.close()
        if self.is_alive:
            raise RuntimeError(
                "the worker thread is still in a step after 30 s; call run_sync again a little "
                "later"
            )
        n_done = 0
        self.error = None
        self.state = "running"
        try:
            while (n is None or n_done < n) and (outcome := self._advance()) != "end":
                n_done += outcome == "step"
        except KeyboardInterrupt:
            self._steps = None  # a generator that was interrupted cannot continue
            self._rest("paused")
            raise
        except Exception as e:
            self._fail(e)
            raise
        self._rest("paused")
        return n_done

    def _ask(self, steps: float | int, next_state: State = "paused") -> None:
        with self._asking:
            more = self._steps_left if self._steps_left < math.inf and steps == 1 else 0
            self._steps_left = steps + more
            self._next_state = next_state
            if steps and not self._serving and self.state != "finished":
                self.error = None
                self._serving = True
                context = contextvars.copy_context()  # a new thread inherits neither
                threads = torch.get_num_threads()
                self._thread = threading.Thread(
                    target=context.run, args=(self._work, threads, self._thread), daemon=True
                )
                self._thread.start()
            idle = not self._serving
        if idle and next_state == "stopped" and self.state in ("ready", "paused"):
            self._rest("stopped")
        self.on_state()

    def _work(self, threads: int, previous: threading.Thread | None) -> None:
        if previous is not None:
            previous.join()
        torch.set_num_threads(threads)
        try:
            while self._take():
                self.state = "running"
                outcome = self._advance()
                if outcome == "end":
                    break
                with self._asking:
                    if outcome == "waiting":
                        continue
                    self._steps_left = max(self._steps_left - 1, 0)
            self._leave()
            self._rest(self._next_state)
        except BaseException as e:
            self._leave()
            self._fail(e)

    def _take(self) -> bool:
        """Whether there is another step to do."""
        with self._asking:
            self._serving = self._steps_left > 0
            return self._serving

    def _leave(self) -> None:
        with self._asking:
            self._serving = False

    def _advance(self) -> Literal["step", "waiting", "end"]:
        """One step, or a part of one that waits; "end" when there is none left."""
        with self.lock:
            if self._steps is None:
                self._steps = self._make_steps()
            try:
                result = next(self._steps)
            except StopIteration:
                self.state = "finished"
                return "end"
            if result is WAITING:
                self._on_wait()
            else:
                self.n_steps += 1
                self._on_step(result)
        time.sleep(0.001)  # long enough for a thread that waits for the lock to get it
        return "waiting" if result is WAITING else "step"

    def _rest(self, state: State) -> None:
        with self.lock:
            if self.state != "finished":
                self.state = state
            self._on_rest()

    def _fail(self, error: BaseException) -> None:
        self._steps = None  # a generator that raised cannot continue
        self._steps_left = 0
        self.error = error
        self.state = "failed"
        with self.lock:
            try:
                self._on_rest()
            except Exception:  # the first error is the one to show
                log.exception("the error could not be shown")


def error_html(error: BaseException | None) -> str:
    """The error as HTML, with its traceback folded below."""
    if error is None:
        return ""
    trace = html.escape("".join(traceback.format_exception(error)))
    headline = html.escape(f"{type(error).__name__}: {error}")
    return (
        f'<details style="color:#b3261e"><summary>{headline}</summary><pre>{trace}</pre></details>'
    )


_ON_STAGE: "weakref.WeakValueDictionary[type, Any]" = weakref.WeakValueDictionary()


def take_the_stage(new: Any) -> None:
    """Stop what took the stage before of the same class: a cell that is run twice leaves nothing
    going unseen."""
    if (earlier := _ON_STAGE.get(type(new))) is not None:
        earlier.stop()
    _ON_STAGE[type(new)] = new


_ICONS = {"Start": "play", "Pause": "pause", "Step": "step-forward", "Stop": "stop"}


def player_buttons(commands: Any, css_prefix: str, player: Player) -> dict[str, Any]:
    """The four buttons, by their labels; each is enabled only while it does something.

    Args:
        commands: Has the methods ``start``, ``pause``, ``step`` and ``stop``.
        css_prefix: The button "Start" has the CSS class ``{css_prefix}-start``, and so on.
        player: What the commands control; its ``on_state`` is taken.
    """
    import ipywidgets as w

    buttons = {
        name: w.Button(
            description=name,
            icon=icon,
            layout=w.Layout(width="88px"),
        )
        for name, icon in _ICONS.items()
    }
    for name, button in buttons.items():
        button.add_class(f"{css_prefix}-{name.lower()}")
        button.on_click(lambda _, name=name: getattr(commands, name.lower())())
    writing = threading.RLock()

    def show_state() -> None:
        """Disable the buttons that do nothing now."""
        with writing:  # two threads change the state: who writes last has read last
            is_over = player.state == "finished"
            runs = player.keeps_running
            has_begun = runs or player.state in ("running", "paused")
            is_disabled = {
                "Start": is_over or runs,
                "Pause": is_over or not runs,
                "Step": is_over or runs,
                "Stop": is_over or not has_begun,
            }
            for name, button in buttons.items():
                button.disabled = is_disabled[name]

    player.on_state = show_state
    show_state()
    return buttons
