"""A slider that goes back through what was shown of earlier steps."""

from collections.abc import Callable
from typing import Any

MOST_ENTRIES = 400
"""Then every second one is dropped: a long run keeps its beginning, only with larger gaps."""


class Scrubber:
    """Keeps what was shown of each step; ``widget`` is the slider. At its right end it follows the
    newest step.

    Args:
        show: Called with an entry that is to be shown, from the thread of a step or of the slider.
        what: The slider's label.
        css_class: The slider's CSS class.
    """

    def __init__(
        self,
        show: Callable[[Any], None],
        *,
        what: str,
        css_class: str,
    ):
        import ipywidgets as w

        self._show = show
        self.entries: list[Any] = []
        """What is kept, oldest first."""
        self._stride = 1
        self._n_entries = 0
        self.following = True
        """Whether the newest step is shown; false while the slider is at an earlier one."""
        self._moving = False
        self.widget = w.IntSlider(
            min=0,
            max=0,
            value=0,
            description=what,
            disabled=True,
            readout=False,
            layout=w.Layout(width="420px"),
        )
        self.widget.add_class(css_class)
        self.widget.observe(self._on_move, names="value")

    def add(self, entry: Any) -> None:
        """Keep an entry; nothing is shown until ``show_newest``."""
        if self._n_entries % self._stride and self.entries:
            self.entries.pop()
        self.entries.append(entry)
        self._n_entries += 1
        if len(self.entries) > MOST_ENTRIES:
            self.entries = [*self.entries[:-1][::2], entry]
            self._stride *= 2

    def show_newest(self) -> None:
        """Show the newest entry, unless somebody looks at an earlier one."""
        last = len(self.entries) - 1
        if last < 0:
            return
        self._moving = True
        self.widget.max = last
        self.widget.disabled = last == 0
        if self.following:
            self.widget.value = last
        self._moving = False
        if self.following:
            self._show(self.entries[last])

    def go_to(self, position: int) -> None:
        """Show the entry at ``position``."""
        self.show_newest()
        if self.entries:
            self.widget.value = min(position, len(self.entries) - 1)

    def _on_move(self, change: Any) -> None:
        if not self._moving and self.entries:
            position = min(change["new"], len(self.entries) - 1)
            self.following = position == len(self.entries) - 1
            self._show(self.entries[position])
