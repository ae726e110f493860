"""The buttons of everything that a ``Player`` runs: start, pause, step, stop."""

from collections.abc import Callable
from typing import Any

_ICONS = {"Start": "play", "Pause": "pause", "Step": "step-forward", "Stop": "stop"}


def player_buttons(player: Any, css_prefix: str) -> dict[str, Any]:
    """The four buttons, by their labels.

    Args:
        player: Has the methods ``start``, ``pause``, ``step`` and ``stop``.
        css_prefix: The button "Start" has the CSS class ``{css_prefix}-start``, and so on.
    """
    import ipywidgets as w

    buttons = {}
    for name, icon in _ICONS.items():
        act: Callable[[], None] = getattr(player, name.lower())
        buttons[name] = w.Button(description=name, icon=icon, layout=w.Layout(width="88px"))
        buttons[name].add_class(f"{css_prefix}-{name.lower()}")
        buttons[name].on_click(lambda _, act=act: act())
    return buttons
