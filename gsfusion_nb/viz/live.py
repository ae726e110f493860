"""Live views of an iterative computation: buttons, pictures that can be looked back through,
curves."""

import html
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from ..drawing.encoding import encode_jpeg
from ..drawing.live_curves import small_curves
from ..drawing.pictures import Picture
from .display import Bundle, ClickImage, LiveOutput, LostNotice, with_picture
from .mapped_frame import columns_for
from .player import MIN_INTERVAL_S, Player, error_html, player_buttons
from .scrubber import Scrubber

DRAWING_REST = 3.0
"""After drawing, nothing is drawn for this many times as long: drawing takes a quarter of the time
at most."""
LOOKS_BACK = 40
"""The slider goes back through at least this many steps, spread evenly; and through all that were
drawn."""


class LivePictures(LiveOutput):
    """Buttons, pictures with a slider that goes back, and curves of work that is done step by step
    in a thread.

    Args:
        make_steps: As for ``Player``.
        captions: Name -> words of each picture.
        name: Part of the CSS classes.
        what: Word for a step.
        n_steps: Steps of the whole work.
        width: Of one picture on screen, pixels.
    """

    def __init__(
        self,
        make_steps: Callable[[], Iterator[Any]],
        captions: Mapping[str, str],
        *,
        name: str,
        what: str,
        n_steps: int,
        width: int,
    ):
        import ipywidgets as w

        self._n_steps = n_steps
        self._panel_width = width
        self._columns = columns_for(len(captions))
        self._width = self._columns * width
        self._next_draw_s = 0.0
        self._shown_step = 0
        self._writing = threading.RLock()
        self.player = Player(
            make_steps, on_step=self._on_step, on_rest=self.store_output, on_wait=self._on_wait
        )
        self.lock = self.player.lock
        self.buttons = player_buttons(self.player, f"gsnb-{name}", self.player)
        self.scrubber = Scrubber(self._show_kept, what=what, css_class=f"gsnb-{name}-back")
        self.progress = w.IntProgress(
            min=0,
            max=n_steps,
            layout=w.Layout(width="260px"),
        )
        self.status = w.HTML()
        self.error = w.HTML()
        self.status.add_class(f"gsnb-{name}-status")
        self.images = {
            key: ClickImage(width=width, alt=caption) for key, caption in captions.items()
        }
        for key, image in self.images.items():
            image.add_class(f"gsnb-{name}-{key}")
        titles = f"curves over the {what}s: {', '.join(self._series())}"
        self.curves = ClickImage(width=self._width, format="png", alt=titles)
        self.curves.show(self._curves(self._width))
        cells = [
            w.VBox([w.HTML(html.escape(captions[key])), image])
            for key, image in self.images.items()
        ]
        wrap_layout = w.Layout(flex_flow="row wrap")
        rows = [
            w.HBox(cells[i : i + self._columns], layout=wrap_layout)
            for i in range(0, len(cells), self._columns)
        ]
        controls = w.HBox([*self.buttons.values(), self.progress], layout=wrap_layout)
        self.widget = w.VBox(
            [
                controls,
                self.status,
                self.error,
                self.scrubber.widget,
                *rows,
                self.curves,
                LostNotice(),
            ]
        )
        self.widget.add_class(f"gsnb-{name}")

    def run_sync(self, n: int | None = None) -> int:
        """Do ``n`` steps, or all that are left, in the calling thread. Returns how many were
        done."""
        return self.player.run_sync(n)

    def picture(self) -> Picture:
        """The pictures with the curves below, as a stored notebook shows them."""
        with self.lock:
            picture = self._mosaic()
            curves = self._curves(self._width)
        if picture is None:
            return curves
        size = (self._width, round(picture.shape[0] * self._width / picture.shape[1]))
        return np.concatenate([np.asarray(cv2.resize(picture, size), np.uint8), curves])

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        with self.lock:
            self._draw()
            alt = "; ".join([image.alt for image in self.images.values()] + [self.curves.alt])
            return with_picture(
                self.widget._repr_mimebundle_(**kwargs), self.picture(), repr(self), alt=alt
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.player.n_steps} steps)"

    def _series(self) -> Mapping[str, Sequence[float | int]]:
        """Title -> values so far."""
        raise NotImplementedError

    def _keep(self) -> None:
        """Keep the pictures of the newest step for the slider, once."""
        raise NotImplementedError

    def _mosaic(self) -> Picture | None:
        """All pictures in one."""
        raise NotImplementedError

    def _words(self) -> list[str]:
        """What the status line says after the state, as HTML."""
        raise NotImplementedError

    def _on_step(self, _result: Any) -> None:
        if self.player.n_steps % max(1, self._n_steps // LOOKS_BACK) == 0:
            self._keep()
        if time.monotonic() >= self._next_draw_s:
            self._draw()

    def _on_wait(self) -> None:
        if (now := time.monotonic()) >= self._next_draw_s:
            self._write_status()
            self._next_draw_s = now + MIN_INTERVAL_S

    def _draw(self) -> None:
        began = time.monotonic()
        with self.lock:
            if self.player.error is None:
                self._keep()
                self.scrubber.show_newest()
                self.curves.show(self._curves(self._width))
            self._write_status()
        end = time.monotonic()
        self._next_draw_s = max(began + MIN_INTERVAL_S, end + DRAWING_REST * (end - began))

    def _curves(self, width: int) -> Picture:
        return small_curves(self._series(), n_x=self._n_steps, width=width)

    def _show_kept(self, stored: tuple[int, dict[str, bytes]]) -> None:
        """Put the pictures of a step into the widget."""
        self._shown_step, pictures = stored
        for name, picture in pictures.items():
            self.images[name].value = picture
        self._write_status()

    def _write_status(self) -> None:
        """Show the state of now. Called from two threads: who writes last must also be who read the
        state last."""
        with self._writing:
            words = [f"<b>{self.player.state}</b>", *self._words()]
            self.status.value = " · ".join(word for word in words if word)
            self.error.value = error_html(self.player.error)


class LiveLoop(LivePictures):
    """Runs an iterator step by step in its own thread, controlled by buttons; other cells can run
    meanwhile.

    The last line of a cell shows it. From Python: ``player.start()``, ``pause``, ``step``,
    ``stop``, and ``run_sync(n)``, which does ``n`` steps in the calling cell.

    Args:
        make_steps: Makes the iterator; called again after a stop, it continues from the current
            state.
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
        self._picture = picture
        self._values = curves
        self._last_stored = -1
        captions = {"image": "the picture of this step"}
        super().__init__(
            make_steps, captions, name="live-loop", what="step", n_steps=n_steps, width=width
        )
        self._draw()

    def _series(self) -> Mapping[str, Sequence[float | int]]:
        return self._values

    def _mosaic(self) -> Picture:
        return self._picture()

    def _keep(self) -> None:
        if self._last_stored != self.player.n_steps:
            self._last_stored = self.player.n_steps
            self.scrubber.add((self._last_stored, {"image": encode_jpeg(self._picture())}))

    def _words(self) -> list[str]:
        self.progress.value = n_done = self.player.n_steps
        # several curves one after the other
        of = f" of {self._n_steps}" if n_done <= self._n_steps else ""
        return [
            f"step {n_done}{of}",
            "" if self.scrubber.following else f"looking back at step {self._shown_step}",
        ]
