"""A slider back through the pictures of a live view, from the first step to the newest."""

from collections.abc import Callable
from typing import Any

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
