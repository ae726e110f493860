"""The buttons of everything that a ``Player`` runs: start, pause, step, stop."""

import threading
from collections.abc import Callable
from typing import Any

from .player import Player

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
