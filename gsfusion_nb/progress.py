"""How far a long piece of work is: a bar, or lines in a log."""

import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO, TypeVar

T = TypeVar("T")

EVERY_S = 10.0
"""Time between two lines of a log, seconds; shorter work writes none."""


class ProgressDisplay:
    """Progress of one piece of work, as a context manager: tqdm's bar, or a line every ``EVERY_S``
    seconds in a log.

        with ProgressDisplay("mapping", total=len(frames), unit="frame") as progress:
            for n, frame in enumerate(frames, start=1):
                ...
                progress.show(n, note=f"PSNR {psnr_db:.1f} dB")

    Args:
        what: What is being done, a word or two.
        total: How much there is to do; None if that is not known (yet).
        unit: What is counted, in the singular; "B" for bytes, which are shown in kB, MB or GB.
        first: How much was there before.
        leave: Whether the bar is kept when the work is done.
        visible: False shows nothing at all.
        stream: Where to; standard error by default.
    """

    def __init__(
        self,
        what: str,
        *,
        total: int | None = None,
        unit: str = "",
        first: int = 0,
        leave: bool = True,
        visible: bool = True,
        stream: TextIO | None = None,
    ):
        from tqdm.auto import tqdm

        to: TextIO = stream or sys.stderr
        is_static = (
            os.environ.get("GSNB_VIEW") == "static"
        )  # a notebook that is executed to be read
        pause_s = 0.1 if to.isatty() or _in_notebook() else EVERY_S
        self._bar = tqdm(
            desc=what,
            total=total,
            unit=unit or "it",
            unit_scale=unit == "B",
            initial=first,
            leave=leave,
            file=to,
            disable=not visible or is_static,
            mininterval=pause_s,
            maxinterval=EVERY_S,
            delay=0 if pause_s < EVERY_S else EVERY_S,
        )

    def show(
        self,
        count: int,
        *,
        total: int | None = None,
        what: str | None = None,
        note: str = "",
    ) -> None:
        """Say how much is done now.

        Args:
            count: In all.
            total: How much there is to do, if that has changed.
            what: In place of what was said at first.
            note: More about the present state.
        """
        if total is not None:
            self._bar.total = total
        if what is not None:
            self._bar.set_description_str(what, refresh=False)
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(count - self._bar.n)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items one after another; each counts as done when the next one is asked for."""
        for count, item in enumerate(items, start=1):
            yield item
            self.show(count)

    def close(self) -> None:
        """The work is over, finished or not."""
        self._bar.close()

    def __enter__(self) -> "ProgressDisplay":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def _in_notebook() -> bool:
    """Whether a Jupyter kernel shows what is printed."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and "IPKernelApp" in shell.config
