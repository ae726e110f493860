"""How far a long piece of work is: a bar on a terminal or in a notebook, a line every ten seconds in a log."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TextIO, TypeVar

T = TypeVar("T")

EVERY_S = 10.0
"""Time between two lines of a log."""


class ProgressDisplay:
    """Progress of one piece of work, as a context manager; the log gets a last line when the block ends.

        with ProgressDisplay("mapping", total=len(frames), unit="frame") as progress:
            for n, frame in enumerate(frames, start=1):
                ...
                progress.show(n, note=f"PSNR {psnr_db:.1f} dB")

    Args:
        what: What is being done, a word or two.
        total: How much there is to do; None if that is not known (yet).
        unit: What is counted, in the singular; "B" for bytes, which are shown in kB, MB or GB.
        done: How much was done before.
        leave: Whether a terminal keeps the bar when the work is done. If False, a log is not told of work that is over
            before its first line.
        shown: False shows nothing at all.
        stream: Where to; standard error by default.
        clock: Seconds.
    """

    def __init__(
        self,
        what: str,
        *,
        total: int | None = None,
        unit: str = "",
        done: int = 0,
        leave: bool = True,
        shown: bool = True,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        to: TextIO = stream or sys.stderr
        self._display: _Bar | _Lines | None = None
        if shown and (to.isatty() or _in_notebook()):
            self._display = _Bar(what, total, unit, done, leave, to)
        elif shown:
            self._display = _Lines(what, total, unit, done, leave, to, clock)

    def show(self, done: int, *, total: int | None = None, what: str | None = None, note: str = "") -> None:
        """Say how much is done now.

        Args:
            done: In all.
            total: How much there is to do, if that has changed.
            what: In place of what was said at first.
            note: More about the present state.
        """
        if self._display is not None:
            self._display.show(done, total, what, note)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items one after another; each counts as done when the next one is asked for."""
        for done, item in enumerate(items, start=1):
            yield item
            self.show(done)

    def close(self) -> None:
        """The work is over, finished or not."""
        if self._display is not None:
            self._display.close()

    def __enter__(self) -> "ProgressDisplay":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class _Bar:
    """tqdm's bar: a line that is drawn over itself, or a widget."""

    def __init__(self, what: str, total: int | None, unit: str, done: int, leave: bool, stream: TextIO):
        from tqdm.auto import tqdm

        self._bar = tqdm(
            desc=what, total=total, unit=unit or "it", unit_scale=unit == "B", initial=done, leave=leave, file=stream
        )

    def show(self, done: int, total: int | None, what: str | None, note: str) -> None:
        if total is not None:
            self._bar.total = total
        if what is not None:
            self._bar.set_description_str(what, refresh=False)
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        self._bar.close()


class _Lines:
    """Lines for a log file, a pipe, or continuous integration."""

    def __init__(
        self,
        what: str,
        total: int | None,
        unit: str,
        done: int,
        leave: bool,
        stream: TextIO,
        clock: Callable[[], float],
    ):
        self._what, self._total, self._unit, self._done = what, total, unit, done
        self._leave, self._stream, self._clock, self._note = leave, stream, clock, ""
        self._begun_s = self._said_s = clock()
        self._said = ""

    def show(self, done: int, total: int | None, what: str | None, note: str) -> None:
        self._done, self._note = done, note
        self._total = self._total if total is None else total
        self._what = what or self._what
        if self._clock() - self._said_s >= EVERY_S:
            self._say()

    def close(self) -> None:
        if (self._leave or self._said) and (self._note or self._done):
            self._say()

    def _say(self) -> None:
        self._said_s = self._clock()
        if (state := self._state()) != self._said:
            self._said = state
            self._stream.write(f"{state}, {self._said_s - self._begun_s:.0f} s{self._note and '; '}{self._note}\n")
            self._stream.flush()

    def _state(self) -> str:
        if self._unit == "B":
            count = _bytes(self._done) + (f" of {_bytes(self._total)}" if self._total else "")
        else:
            of = f" of {self._total:,}" if self._total else ""
            plural = "s" if self._unit and (self._total or self._done) != 1 else ""
            count = f"{self._done:,}{of} {self._unit}{plural}".rstrip()
        share = f" ({100 * self._done / self._total:.0f} %)" if self._total else ""
        return f"{self._what}: {count}{share}"


def _bytes(n: int) -> str:
    for power, name in ((9, "GB"), (6, "MB"), (3, "kB")):
        if n >= 10**power:
            return f"{n / 10**power:.1f} {name}"
    return f"{n} B"


def _in_notebook() -> bool:
    """Whether a Jupyter kernel shows what is printed."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    shell = get_ipython()
    return shell is not None and "IPKernelApp" in shell.config
