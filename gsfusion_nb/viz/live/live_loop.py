"""A live view of any iterative computation: buttons to start, pause, step and stop it, one picture, and curves."""

import html
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...drawing.pictures import Picture, encode_drawing, encode_jpeg, on_card
from ...drawing.small_curves import small_curves
from ..display import Bundle, with_picture
from ..lost import LostNotice
from ..panels.click_image import ClickImage
from .player import Player, Scrubber, player_buttons

MIN_INTERVAL_S = 0.1
"""The picture is redrawn at most ten times a second."""
LOOKS_BACK = 40
"""The slider goes back through at least this many steps, spread evenly; and through all that were drawn."""


class LiveLoop:
    """Runs an iterator step by step in its own thread, controlled by buttons; other cells can run meanwhile.

    The last line of a cell shows it. From Python: ``player.start``, ``player.pause``, ``player.step``, ``player.stop``,
    and ``run_sync(n)``, which does ``n`` steps in the calling cell.

    Args:
        make_steps: Makes the iterator; called again after a stop, it continues from the current state.
        picture: Makes the picture to show; called with the lock held, at most ten times a second.
        curves: Title -> values so far, lists that the steps append to.
        n_steps: Number of steps that the width of the curves stands for.
        width: Of the picture on screen, pixels.
    """

    def __init__(
        self,
        make_steps: Callable[[], Iterator[Any]],
        picture: Callable[[], Picture],
        curves: Mapping[str, Sequence[float | int]],
        *,
        n_steps: int,
        width: int = 720,
    ):
        self._picture, self._series, self._n_steps, self._width = picture, curves, n_steps, width
        self.player = Player(make_steps, on_step=self._on_step, on_rest=self._draw)
        self._next_draw_s, self._kept, self._shown = 0.0, -1, 0
        self._build()
        self._draw()

    @property
    def lock(self) -> Any:
        """Held during a step."""
        return self.player.lock

    def run_sync(self, n: int | None = None) -> int:
        """Do ``n`` steps, or all that are left, in the calling thread. Returns how many were done."""
        return self.player.run_sync(n)

    def picture(self) -> Picture:
        """The picture with the curves below it, as a stored notebook shows it."""
        import cv2

        with self.lock:
            picture, curves = self._picture(), on_card(self._graphs())
        size = (picture.shape[1], round(curves.shape[0] * picture.shape[1] / curves.shape[1]))
        return np.concatenate([picture, np.asarray(cv2.resize(curves, size, interpolation=cv2.INTER_AREA), np.uint8)])

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self._draw()
        words = f"LiveLoop({self.player.n_steps} steps)"
        bundle = self.widget._repr_mimebundle_(**kwargs)
        return with_picture(
            bundle, self.picture(), words, alt=f"the picture of step {self.player.n_steps}; {self.graphs.alt}"
        )

    def _on_step(self, _result: Any) -> None:
        if self.player.n_steps % max(1, self._n_steps // LOOKS_BACK) == 0:
            self._keep()
        if time.monotonic() >= self._next_draw_s:
            self._draw()

    def _keep(self) -> None:
        """Keep the picture of this step for the slider."""
        if self._kept != self.player.n_steps:
            self._kept = self.player.n_steps
            self.scrubber.add((self._kept, encode_jpeg(self._picture())))

    def _show_kept(self, kept: tuple[int, bytes]) -> None:
        self._shown, self.image.value = kept
        self._write_status()

    def _draw(self) -> None:
        began = time.monotonic()
        with self.lock:
            if self.player.error is None:
                self._keep()
                self.scrubber.show_newest()
                self.graphs.value = encode_drawing(self._graphs())
            self._write_status()
        ended = time.monotonic()
        self._next_draw_s = max(began + MIN_INTERVAL_S, ended + 2 * (ended - began))  # a third of the time at most

    def _write_status(self) -> None:
        state, error = self.player.state, self.player.error
        done = self.player.n_steps
        of = f" of {self._n_steps}" if done <= self._n_steps else ""  # several curves one after the other
        words = f"<b>{state}</b> · step {done}{of}"
        if not self.scrubber.following:
            words += f" · looking back at step {self._shown}"
        if error is not None:
            said = html.escape(f"{type(error).__name__}: {error}")
            words += f'<br><span style="color:#b3261e">{said}</span>'
        self.status.value = words

    def _graphs(self) -> Picture:
        each = self._width // max(len(self._series), 1)
        return small_curves(self._series, n_x=self._n_steps, width=each)

    def _build(self) -> None:
        import ipywidgets as w

        self.buttons = player_buttons(self.player, "gsnb-live-loop", self.player)
        self.scrubber = Scrubber(self._show_kept, what="step", css_class="gsnb-live-loop-step-back")
        self.status = w.HTML()
        self.status.add_class("gsnb-live-loop-status")
        self.image = ClickImage(1, 1, width=self._width, alt="the picture of this step", touch="")
        titles = ", ".join(self._series)
        self.graphs = ClickImage(1, 1, width=self._width, format="png", alt=f"curves: {titles}", touch="")
        self.image.add_class("gsnb-live-loop-image")
        controls = w.HBox([*self.buttons.values(), self.scrubber.widget], layout=w.Layout(flex_flow="row wrap"))
        self.widget = w.VBox([controls, self.status, self.image, self.graphs, LostNotice()])
        self.widget.add_class("gsnb-live-loop")
