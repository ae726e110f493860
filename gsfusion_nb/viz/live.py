"""Live views: of online mapping, and of any other iterative computation."""

import dataclasses
import html
import logging
import math
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..data import SequenceError
from ..drawing.curves import small_curves
from ..drawing.pictures import Picture, encode_jpeg
from ..mapping import StepReport
from ..runs import MappingRun
from ..types import Frame
from .display import Bundle, ClickImage, LostNotice, with_picture
from .map_pictures import LivePanels, captions_of, columns_for, live_panels
from .player import Player, Scrubber, player_buttons
from .splat_viewer import SplatViewer

log = logging.getLogger(__name__)

MIN_INTERVAL_S = 0.1
"""Pictures are redrawn at most ten times a second."""
MAX_DRAWING_SHARE = 0.25
"""Drawing takes at most this share of the time while frames are waiting."""
EVERY_FRAME_PIXELS = 100_000
"""Of images up to this size the panels of every frame are kept; of larger ones those that were drawn."""

_on_stage: "weakref.ref[LiveMapper] | None" = None
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
            picture = self._picture()
            size = (self._width, round(picture.shape[0] * self._width / picture.shape[1]))
            return np.concatenate([np.asarray(cv2.resize(picture, size), np.uint8), self._graphs(self._width)])

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
                self.graphs.show(self._graphs(self._width))
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

    def _graphs(self, width: int) -> Picture:
        return small_curves(self._series, n_x=self._n_steps, width=width)

    def _build(self) -> None:
        import ipywidgets as w

        self.buttons = player_buttons(self.player, "gsnb-live-loop", self.player)
        self.scrubber = Scrubber(self._show_kept, what="step", css_class="gsnb-live-loop-step-back")
        self.status = w.HTML()
        self.status.add_class("gsnb-live-loop-status")
        self.image = ClickImage(width=self._width, alt="the picture of this step")
        titles = ", ".join(self._series)
        self.graphs = ClickImage(width=self._width, format="png", alt=f"curves: {titles}")
        self.image.add_class("gsnb-live-loop-image")
        controls = w.HBox([*self.buttons.values(), self.scrubber.widget], layout=w.Layout(flex_flow="row wrap"))
        self.widget = w.VBox([controls, self.status, self.image, self.graphs, LostNotice()])
        self.widget.add_class("gsnb-live-loop")


class LiveMapper:
    """Runs the online part of a ``MappingRun`` frame by frame in its own thread; other cells can run meanwhile.

    The last line of a cell shows it. From Python: ``start``, ``pause``, ``step``, ``stop``, and ``run_sync(n)``, which
    maps ``n`` frames (or all that are left) in the calling cell. ``lock`` is held during a step; pass it to any code
    that reads the maps at the same time. Making another ``LiveMapper`` stops this one, so running a cell twice does not
    leave the first run going unseen.

    Args:
        run: The run; it may have mapped some frames already.
        panel_width: Width of each panel on screen, pixels.

    ``splats()`` makes a splat viewer that follows the map; show it in a cell of its own. The slider ``frame`` goes back
    through the frames that were mapped; ``run_sync()`` to the end leaves it at the frame that added most.
    """

    def __init__(self, run: MappingRun, *, panel_width: int = 320):
        global _on_stage
        if _on_stage is not None and (earlier := _on_stage()) is not None:
            earlier.player.stop()
        _on_stage = weakref.ref(self)
        self.run = run
        self.viewer: SplatViewer | None = None
        """The splat viewer made by ``splats``; it is updated together with the panels."""
        self.player = Player(run.online, on_step=self._on_step, on_rest=self._on_rest)
        self.lock = self.player.lock
        self.panels: LivePanels | None = None
        self._writing = threading.RLock()
        self._undrawn: StepReport | None = None
        self._next_draw_s = 0.0
        self._kept = self._shown = 0
        self._build(panel_width)
        self._write_status()

    def start(self) -> None:
        """Map until paused, stopped or done."""
        self.player.start()
        self._write_status()

    def pause(self) -> None:
        """Pause after the current frame."""
        self.player.pause()

    def step(self) -> None:
        """Map one frame."""
        self.player.step()

    def stop(self) -> None:
        """Stop the thread after the current frame; ``start`` continues from there."""
        self.player.stop()
        self._write_status()

    def run_sync(self, n: int | None = None) -> int:
        """Map ``n`` frames, or all that are left, in this thread. Returns how many were mapped.

        After the last one of several it shows the frame worth looking at (``show_frame``).
        """
        done = self.player.run_sync(n)
        if self.player.state == "finished" and done:
            self.show_frame(worth_looking_at(self.run.steps))
        return done

    def show_frame(self, n_mapped: int) -> None:
        """Show the panels as they were after ``n_mapped`` frames, or the nearest that were kept."""
        kept = [at for at, _ in self.scrubber.entries]
        if kept:
            self.scrubber.go_to(min(range(len(kept)), key=lambda i: abs(kept[i] - n_mapped)))

    def join(self, timeout_s: float | int | None = None) -> bool:
        """Wait until the thread has ended. Returns whether it has."""
        return self.player.join(timeout_s)

    def close(self) -> None:
        """Stop, and wait until the thread has ended."""
        self.player.close()

    def splats(self, **options: Any) -> SplatViewer:
        """A splat viewer that is updated while the map grows; ``options`` are those of ``SplatViewer``.

        Its time slider shows the map as it was at earlier frames. After another call only the newer viewer follows the
        map.
        """
        if not len(self.run.mapper.keyframes) and len(self.run.sequence.mapping):  # no keyframe yet
            first = self.run.sequence.mapping[0]
            options = {"camera": first.camera, "T_WC": first.T_WC} | options
        self.viewer = SplatViewer(self.run.mapper, lock=self.lock, **options)
        return self.viewer

    def picture(self) -> Picture:
        """The panels and curves in one picture, as a stored notebook shows them."""
        if self.panels is None:
            return self._curves(self._width)
        small = next(iter(self.panels.pictures.values())).shape[1]
        mosaic = self.panels.mosaic(max(1, round(self._panel_width / small)))
        return np.concatenate([mosaic, self._curves(mosaic.shape[1])])

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        with self.lock:
            self._draw()
            self._write_status()
            bundle, words = self.widget._repr_mimebundle_(**kwargs), f"LiveMapper({self.run!r})"
            alt = "; ".join([image.alt for image in self.images.values()] + [self.curves.alt])
            return with_picture(bundle, self.picture(), words, alt=alt)

    def _on_step(self, report: StepReport) -> None:
        self._undrawn = report
        camera = self.run.sequence.camera
        if camera.width * camera.height <= EVERY_FRAME_PIXELS:
            self._keep()
        if time.monotonic() >= self._next_draw_s:
            self._draw()
            self._write_status()

    def _on_rest(self) -> None:
        if self.player.error is None:
            self._draw()
        self._write_status()

    def _draw(self) -> None:
        """Draw the panels again if a frame was mapped since the last time."""
        if self._undrawn is None:
            return
        began = time.monotonic()
        if not self._keep():
            return
        self._undrawn = None
        self.scrubber.show_newest()
        self.curves.show(self._curves(self._width))
        if self.viewer is not None:
            self.viewer.update(self.run.mapper)
        ended = time.monotonic()
        self._next_draw_s = max(began + MIN_INTERVAL_S, ended + (ended - began) * (1 / MAX_DRAWING_SHARE - 1))

    def _keep(self) -> bool:
        """Keep the panels of the frame mapped last for the slider; whether there are any."""
        if self._kept == self.run.next_position:
            return True
        try:
            frame = self._last_frame()
        except SequenceError as e:
            log.warning("the panels were not redrawn: %s", e)
            self._undrawn = None
            return False
        self.panels, self._kept = live_panels(self.run.mapper, frame), self.run.next_position
        pictures = {name: encode_jpeg(self.panels[name]) for name in self.images}
        self.scrubber.add((len(self.run.steps), pictures))
        return True

    def _show_kept(self, kept: tuple[int, dict[str, bytes]]) -> None:
        """Put the pictures of a frame into the panels."""
        self._shown, pictures = kept
        for name, picture in pictures.items():
            self.images[name].value = picture
        self._write_status()

    def _last_frame(self) -> Frame:
        """The frame mapped last, with the pose it was mapped at."""
        frame = self.run.sequence.mapping[self.run.next_position - 1]
        mapped = self.run.mapper.localiser
        if not mapped.poses or mapped.frame_indices[-1] != frame.index:  # frames after it were skipped
            return frame
        return dataclasses.replace(frame, T_WC=mapped.poses[-1].to(frame.T_WC))

    def _curves(self, width: int) -> Picture:
        series = {title: [value(s) for s in self.run.steps] for title, value in self.run.mapper.curves.items()}
        return small_curves(series, n_x=len(self.run.sequence.mapping), width=width)

    def _build(self, panel_width: int) -> None:
        import ipywidgets as w

        self._panel_width = panel_width
        captions = captions_of(self.run.mapper)
        self._width = columns_for(len(captions)) * panel_width
        self.buttons = player_buttons(self, "gsnb-live", self.player)
        self.scrubber = Scrubber(self._show_kept, what="frame", css_class="gsnb-live-frame")
        self.progress = w.IntProgress(min=0, max=len(self.run.sequence.mapping), layout=w.Layout(width="260px"))
        self.status = w.HTML()
        self.status.add_class("gsnb-live-status")
        self.error = w.HTML()
        self.images = {name: ClickImage(width=panel_width, alt=caption) for name, caption in captions.items()}
        for name, image in self.images.items():
            image.add_class(f"gsnb-live-{name}")
        cells = [w.VBox([w.HTML(html.escape(captions[name])), image]) for name, image in self.images.items()]
        wide = columns_for(len(cells))
        wrapped = w.Layout(flex_flow="row wrap")
        rows = [w.HBox(cells[i : i + wide], layout=wrapped) for i in range(0, len(cells), wide)]
        titles = f"curves over the frames: {', '.join(self.run.mapper.curves)}"
        self.curves = ClickImage(width=self._width, format="png", alt=titles)
        self.curves.show(self._curves(self._width))
        controls = w.HBox([*self.buttons.values(), self.progress], layout=wrapped)
        parts = [controls, self.status, self.error, self.scrubber.widget, *rows, self.curves, LostNotice()]
        self.widget = w.VBox(parts)
        self.widget.add_class("gsnb-live")

    def _write_status(self) -> None:
        """Show the state of now. Called from two threads: who writes last must also be who read the state last."""
        with self._writing:
            run, state = self.run, self.player.state
            self.progress.value = run.next_position
            fidelity = run.mapper.fidelity_of(run.mapper.config)
            words = [
                f"<b>{state}</b>",
                f"{run.mapper.title} ({html.escape(fidelity)})" if fidelity else run.mapper.title,
                f"{run.next_position} of {len(run.sequence.mapping)} frames",
            ]
            at = len(run.steps) if self.scrubber.following else self._shown
            if at:
                last = run.steps[at - 1]
                recent = run.steps[max(at - 10, 0) : at]
                back = "" if at == len(run.steps) else "looking back at "
                seconds = sum(s.total_seconds for s in recent)
                words += [
                    f"{back}frame {last.frame_index}{' (keyframe)' if last.is_keyframe else ''}",
                    f"{last.n_seeds:,} new Gaussians",
                    ""
                    if math.isnan(last.psnr_before_db + last.psnr_after_db)
                    else f"PSNR {last.psnr_before_db:.1f} → {last.psnr_after_db:.1f} dB",
                    f"{len(recent) / seconds:.1f} frames/s" if seconds > 0 else "",
                ]
            self.status.value = " · ".join(word for word in words if word)
            self.error.value = _as_html(self.player.error)


def worth_looking_at(steps: Sequence[StepReport]) -> int:
    """How many frames had been mapped after the one with most new Gaussians, the first tenth of the run left out."""
    late = range(len(steps) // 10 + 1, len(steps))
    return 1 + max(late, key=lambda i: steps[i].n_seeds) if late else len(steps)


def _as_html(error: BaseException | None) -> str:
    """The error as HTML, with its traceback folded below."""
    if error is None:
        return ""
    trace = html.escape("".join(traceback.format_exception(error)))
    headline = html.escape(f"{type(error).__name__}: {error}")
    return f'<details style="color:#b3261e"><summary>{headline}</summary><pre>{trace}</pre></details>'
