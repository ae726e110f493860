"""Options of commands that map: the map in a browser tab while it grows."""

import contextlib
import os
import sys
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from ..errors import ArgumentError
from .result import print_result

if TYPE_CHECKING:
    from ..runs import FinishedRun
    from ..viz import BrowserTab


@dataclass(frozen=True, kw_only=True)
class WatchOptions:
    """The map in a browser tab."""

    watch: bool = False
    """Show the map in a browser tab while it grows, and until Ctrl-C; needs the extra watch."""
    watch_host: str = "127.0.0.1"
    """Address at which the tab can be opened: this machine alone by default; 0.0.0.0 lets everyone
    in the network see the map and the pictures."""
    watch_port: int = 8080
    """Port of the tab; if it is taken, the next free one."""
    watch_stays: bool = True
    """--no-watch-stays: the tab's address closes with the run."""

    @contextlib.contextmanager
    def tab(self) -> Iterator["BrowserTab | None"]:
        """The tab, which is closed at the end; None without --watch.

        Raises:
            ArgumentError: another option of the tab without --watch.
        """
        if not self.watch:
            changed = [f for f in fields(WatchOptions) if getattr(self, f.name) != f.default]
            if changed:
                name = changed[0].name.replace("_", "-")
                raise ArgumentError(f"--{name} is for the tab that --watch opens")
            yield None
            return
        from ..viz import BrowserTab

        with BrowserTab(host=self.watch_host, port=self.watch_port) as tab:
            print(f"The map grows at {tab.url} ({tab.who_sees()}).", file=sys.stderr)
            if tab.is_private and _has_desktop():
                webbrowser.open(tab.url)
            yield tab

    def print_and_stay(self, run: "FinishedRun", tab: "BrowserTab | None") -> int:
        """Print the results, and keep the tab until Ctrl-C. Returns the exit status."""
        status = print_result(run)
        if tab is not None and self.watch_stays and run.run.status != "interrupted":
            print(f"The map stays at {tab.url} until Ctrl-C.", file=sys.stderr)
            tab.wait()
        return status


def _has_desktop() -> bool:
    """Whether a browser has a window to open in; on a server it would be one of the terminal."""
    is_remote = "SSH_CONNECTION" in os.environ
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    has_window = sys.platform != "linux" or any(os.environ.get(name) for name in names)
    return has_window and not is_remote
