"""A thread that runs an iterator and can be paused, stepped and stopped while other cells run."""

import contextvars
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch

log = logging.getLogger(__name__)

State = Literal["ready", "running", "paused", "stopped", "finished", "failed"]


class Player:
    """Runs the iterator that ``make_steps()`` returns in a thread of its own.

    Widgets and tests use the same methods: ``start``, ``pause``, ``step``, ``stop``, ``join``; ``run_sync`` does the
    work in the calling thread. ``lock`` is held during a step: hold it too when reading what the steps change.

    Args:
        make_steps: Makes the iterator. It is called again after a stop or an error and must then continue from the
            current state, not start again.
        on_step: Called after each step with what the iterator yielded, in the thread of the step, with the lock held.
        on_rest: Called with the lock held when the work has paused, stopped, finished or failed.

    An exception ends the work: ``state`` is "failed" and ``error`` holds the exception. It is not printed, because the
    output of a thread may appear under any cell.
    """

    def __init__(
        self,
        make_steps: Callable[[], Iterator[Any]],
        *,
        on_step: Callable[[Any], None] = lambda _: None,
        on_rest: Callable[[], None] = lambda: None,
    ):
        self._make_steps, self._on_step, self._on_rest = make_steps, on_step, on_rest
        self._steps: Iterator[Any] | None = None
        self.lock = threading.RLock()
        self.on_state: Callable[[], None] = lambda: None
        """Called after each change of ``state`` and each request, from any thread."""
        self._state: State = "ready"
        self.error: BaseException | None = None
        self.n_steps = 0
        """Steps done."""
        self._wish = threading.Condition()
        self._run, self._stop, self._singles = False, False, 0
        self._thread: threading.Thread | None = None
        self._serving = False
        """The thread is running and will read new requests; changes only while ``_wish`` is held."""

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
        return self._run and self._state not in ("finished", "failed")

    @property
    def is_alive(self) -> bool:
        """Whether the worker thread exists (it also exists while paused)."""
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> None:
        """Run until paused, stopped or finished."""
        self._want(run=True)
        self._ensure_thread()

    def pause(self) -> None:
        """Pause after the current step."""
        self._want(run=False)

    def step(self) -> None:
        """Do one step, then pause."""
        self._want(run=False, single=True)
        self._ensure_thread()

    def stop(self) -> None:
        """Stop the thread after the current step. ``start`` continues from there."""
        self._want(run=False, stop=True)
        if not self._serving and self.state in ("ready", "paused"):
            self.state = "stopped"

    def close(self, timeout_s: float | int = 30.0) -> None:
        """Stop, and wait until the thread has ended."""
        self.stop()
        self.join(timeout_s)

    def join(self, timeout_s: float | int | None = None) -> bool:
        """Wait until the thread has ended. Returns whether it has. A paused thread does not end by itself."""
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
            raise RuntimeError("the worker thread is still in a step after 30 s; call run_sync again a little later")
        done, self.error, self.state = 0, None, "running"
        try:
            while (n is None or done < n) and self._advance():
                done += 1
        except KeyboardInterrupt:
            self._steps = None  # a generator that was interrupted cannot continue
            self._rest("paused")
            raise
        except Exception as e:
            self._fail(e)
            raise
        self._rest("paused")
        return done

    def _want(self, *, run: bool, stop: bool = False, single: bool = False) -> None:
        with self._wish:
            self._run, self._stop = run, stop
            self._singles = self._singles + 1 if single else 0
            self._wish.notify_all()
        self.on_state()

    def _ensure_thread(self) -> None:
        with self._wish:
            if self._serving or self.state == "finished":
                return
            self.error, self._serving = None, True
            context, threads = contextvars.copy_context(), torch.get_num_threads()  # a new thread inherits neither
            previous = self._thread
            self._thread = threading.Thread(target=context.run, args=(self._work, threads, previous), daemon=True)
            self._thread.start()

    def _work(self, threads: int, previous: threading.Thread | None) -> None:
        if previous is not None:
            previous.join()
        torch.set_num_threads(threads)
        state: State = "stopped"
        try:
            while self._wait_for_work():
                self.state = "running"
                if not self._advance():
                    state = "finished"
                    break
                with self._wish:
                    self._singles = max(self._singles - 1, 0)
                    idle = not (self._run or self._singles or self._stop)
                if idle:
                    self._rest("paused")
            self._leave()
            self._rest(state)
        except BaseException as e:
            self._leave()
            self._fail(e)

    def _wait_for_work(self) -> bool:
        """Sleep while paused; False when asked to stop."""
        with self._wish:
            self._wish.wait_for(lambda: self._stop or self._run or self._singles)
            self._serving = not self._stop
            return self._serving

    def _leave(self) -> None:
        with self._wish:
            self._serving = False

    def _advance(self) -> bool:
        """One step; False when there is none left."""
        with self.lock:
            if self._steps is None:
                self._steps = self._make_steps()
            try:
                result = next(self._steps)
            except StopIteration:
                self.state = "finished"
                return False
            self.n_steps += 1
            self._on_step(result)
        time.sleep(0.001)  # long enough for a thread that waits for the lock to get it
        return True

    def _rest(self, state: State) -> None:
        with self.lock:
            if self.state != "finished":
                self.state = state
            self._on_rest()

    def _fail(self, error: BaseException) -> None:
        self._steps = None  # a generator that raised cannot continue
        self._run = False
        self.error, self.state = error, "failed"
        with self.lock:
            try:
                self._on_rest()
            except Exception:  # the first error is the one to show
                log.exception("the error could not be shown")


_ICONS = {"Start": "play", "Pause": "pause", "Step": "step-forward", "Stop": "stop"}


def player_buttons(commands: Any, css_prefix: str, player: Player) -> dict[str, Any]:
    """The four buttons, by their labels; each is enabled only while it does something.

    Args:
        commands: Has the methods ``start``, ``pause``, ``step`` and ``stop``.
        css_prefix: The button "Start" has the CSS class ``{css_prefix}-start``, and so on.
        player: What the commands control; its ``on_state`` is taken.
    """
    import ipywidgets as w

    buttons = {}
    for name, icon in _ICONS.items():
        act: Callable[[], None] = getattr(commands, name.lower())
        buttons[name] = w.Button(description=name, icon=icon, layout=w.Layout(width="88px"))
        buttons[name].add_class(f"{css_prefix}-{name.lower()}")
        buttons[name].on_click(lambda _, act=act: act())
    writing = threading.RLock()

    def enable() -> None:
        with writing:  # two threads change the state: who writes last has read last
            for name, useful in useful_buttons(player).items():
                buttons[name].disabled = not useful

    player.on_state = enable
    enable()
    return buttons


def useful_buttons(player: Player) -> dict[str, bool]:
    """Which buttons do something in the state of now."""
    over = player.state == "finished"
    return {
        "Start": not over and not player.keeps_running,
        "Pause": not over and player.keeps_running,
        "Step": not over and not player.keeps_running,
        "Stop": not over and (player.keeps_running or player.state in ("running", "paused")),
    }


MOST_ENTRIES = 400
"""Then every second one is dropped: a long run keeps its beginning, only with larger gaps."""


class Scrubber:
    """Keeps what was shown of each step; ``widget`` is the slider. At its right end it follows the newest step.

    Args:
        show: Called with an entry that is to be shown, from the thread of a step or of the slider.
        what: The slider's label.
        css_class: The slider's CSS class.
    """

    def __init__(self, show: Callable[[Any], None], *, what: str, css_class: str):
        import ipywidgets as w

        self._show = show
        self._entries: list[Any] = []
        self._stride, self._seen, self._following, self._moving = 1, 0, True, False
        self.widget = w.IntSlider(
            min=0, max=0, value=0, description=what, disabled=True, readout=False, layout=w.Layout(width="420px")
        )
        self.widget.add_class(css_class)
        self.widget.observe(self._moved, names="value")

    @property
    def following(self) -> bool:
        """Whether the newest step is shown; false while the slider is at an earlier one."""
        return self._following

    @property
    def entries(self) -> list[Any]:
        """What is kept, oldest first."""
        return list(self._entries)

    def add(self, entry: Any) -> None:
        """Keep an entry; nothing is shown until ``show_newest``."""
        if self._seen % self._stride == 0 or not self._entries:
            self._entries.append(entry)
        else:
            self._entries[-1] = entry
        self._seen += 1
        if len(self._entries) > MOST_ENTRIES:
            self._entries = [*self._entries[:-1][::2], self._entries[-1]]
            self._stride *= 2

    def show_newest(self) -> None:
        """Show the newest entry, unless somebody looks at an earlier one."""
        if not self._entries:
            return
        last = len(self._entries) - 1
        self._moving = True
        try:
            self.widget.max, self.widget.disabled = last, last == 0
            if self._following:
                self.widget.value = last
        finally:
            self._moving = False
        if self._following:
            self._show(self._entries[last])

    def go_to(self, position: int) -> None:
        """Show the entry at ``position``; negative ones count from the newest."""
        self.show_newest()
        last = len(self._entries) - 1
        if last >= 0:
            self.widget.value = min(max(position + (last + 1 if position < 0 else 0), 0), last)

    def _moved(self, change: Any) -> None:
        if self._moving or not self._entries:
            return
        position = min(change["new"], len(self._entries) - 1)
        self._following = position == len(self._entries) - 1
        self._show(self._entries[position])
