"""The widget of a stepper: press Next, and see the line that runs, a picture of it, and its numbers."""

import io
import textwrap
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import anywidget
import numpy as np
import torch
import traitlets as t
from markupsafe import Markup

from ...drawing.curves import BETWEEN
from ...drawing.page import html_table
from ...drawing.pictures import encode_rgba
from ..display import WIDGET_MIME, source, static_views, synced
from .recording import Line, file_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AROUND = 8
"""Lines of code that are shown before and after the one that runs."""
SHARPNESS = 1.5
"""Pixels of the picture for each pixel on screen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """What one press of Next shows."""

    line: Line
    title: str
    """What happens, in one or two sentences."""
    numbers: Sequence[Sequence[str]] = ()
    """Rows of a table."""
    heads: Sequence[str] = ()
    scene: Any = None
    """What the drawing needs."""


def step_of(line: Line, title: str, numbers: Sequence[Sequence[str]], scene: Any, heads: Sequence[str] = ()) -> Step:
    """A ``Step``."""
    return Step(line=line, title=title, numbers=numbers, heads=heads, scene=scene)


Build = Callable[["Figure"], Callable[[Step], bool | None]]
"""Makes the artists of a picture once, and returns the function that changes them to those of a step.

Only animated artists are drawn again at each step; it returns True if the others have changed too."""


class Stepper(anywidget.AnyWidget):
    """Shows one step at a time: its line of code, a picture, its numbers. Buttons, arrow keys and a slider move.

    ``step`` is the number of the step, from 0; ``steps`` are all of them.

    Args:
        steps: What is shown.
        build: Makes the picture.
        name: Part of the CSS class: ``gsnb-stepper-NAME``.
        label: What is stepped through, for screen readers.
        size: Width and height of the picture on screen, pixels.
        stills: Steps that a stored notebook shows, in one picture; by default some evenly spaced ones.
    """

    _esm = source("steppers/stepper.js")
    _css = source("steppers/stepper.css")

    step = synced(t.Int(0))
    count = synced(t.Int(1))
    name = synced(t.Unicode())
    label = synced(t.Unicode())
    width = synced(t.Int(450))
    png = synced(t.Bytes(b""))
    alt = synced(t.Unicode())
    title = synced(t.Unicode())
    code = synced(t.Unicode())
    numbers = synced(t.Unicode())
    shown = synced(t.Int(0))
    """Counts the pictures; the page draws when it changes."""

    def __init__(
        self,
        steps: Sequence[Step],
        build: Build,
        *,
        name: str,
        label: str,
        size: tuple[int, int] = (450, 340),
        stills: Sequence[int] = (),
    ):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        if not steps:
            raise ValueError(f"{label}: there is no step to show")
        super().__init__(count=len(steps), name=name, label=label, width=size[0])
        self.steps = tuple(steps)
        self._stills = tuple(stills) or tuple(sorted({round(i * (len(steps) - 1) / 3) for i in range(1, 4)}))
        self._lock = threading.RLock()  # the page's messages may be handled in another thread
        self._figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100 * SHARPNESS, facecolor="none")
        self._canvas = FigureCanvasAgg(self._figure)
        self._update = build(self._figure)
        moving = [a for a in self._figure.findobj() if a.get_animated()]
        self._moving = sorted(moving, key=lambda artist: artist.get_zorder())
        self._ground: Any = None
        self.observe(lambda _: self._show(), "step")
        self._show()

    @t.validate("step")
    def _inside(self, proposal: Any) -> int:
        return min(max(proposal["value"], 0), self.count - 1)

    def go_to(self, step: int) -> "Stepper":
        """Show a step, from 0; negative numbers count from the end."""
        self.step = step if step >= 0 else self.count + step
        return self

    def next(self) -> "Stepper":
        """Show the next step."""
        return self.go_to(min(self.step + 1, self.count - 1))

    def back(self) -> "Stepper":
        """Show the step before."""
        return self.go_to(max(self.step - 1, 0))

    def restart(self) -> "Stepper":
        """Show the first step."""
        return self.go_to(0)

    def find(self, title: str) -> int:
        """Number of the first step whose title contains a text.

        Raises:
            ValueError: no title does.
        """
        found = next((i for i, step in enumerate(self.steps) if title in step.title), None)
        if found is None:
            raise ValueError(f"no step's title contains {title!r}")
        return found

    def picture(self) -> np.ndarray:
        """The picture of the present step, with its transparent ground. [H, W, 4] bytes"""
        return self._drawn(self.steps[self.step])

    def _drawn(self, step: Step) -> np.ndarray:
        with self._lock:
            if self._update(step) or self._ground is None:
                self._canvas.draw()
                self._ground = self._canvas.copy_from_bbox(self._figure.bbox)
            self._canvas.restore_region(self._ground)
            for artist in self._moving:
                self._figure.draw_artist(artist)
            return np.asarray(self._canvas.buffer_rgba()).copy()

    def _show(self) -> None:
        with self._lock, self.hold_sync():
            now = self.steps[self.step]
            self.png = encode_rgba(self._drawn(now))
            self.alt = f"{self.label}, step {self.step + 1} of {self.count}: {now.title}"
            self.title = str(Markup("{}").format(now.title))
            self.code = code_html(now.line)
            self.numbers = html_table(now.numbers, heads=now.heads)
            self.shown += 1

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        import base64

        bundle = super()._repr_mimebundle_(**kwargs)
        data, metadata = bundle if isinstance(bundle, tuple) else (bundle, {})
        data = dict(data or {})
        if static_views():
            data.pop(WIDGET_MIME, None)
        still = self._still()
        data["image/png"] = base64.b64encode(_palette_png(still)).decode("ascii")
        titles = "; ".join(self.steps[i].title for i in self._stills)
        data["text/plain"] = f"{self.label}: {self.count} steps"
        shown = {"width": round(still.shape[1] / SHARPNESS), "alt": f"{self.label}, steps of {self.count}: {titles}"}
        return data, dict(metadata or {}) | {"image/png": shown}

    def _still(self) -> np.ndarray:
        """Some steps below each other, each with its line and numbers."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        pictures = [self._drawn(self.steps[i]) for i in self._stills]
        height, width = pictures[0].shape[:2]
        wide = width + round(450 * SHARPNESS)
        figure = Figure(figsize=(wide / 100, height * len(pictures) / 100), dpi=100, facecolor="none")
        canvas = FigureCanvasAgg(figure)
        for row, (picture, number) in enumerate(zip(pictures, self._stills, strict=True)):
            figure.figimage(picture, 0, height * (len(pictures) - 1 - row), origin="upper")
            top = 1 - (row + 0.04) / len(pictures)
            figure.text(
                (width + 20) / wide, top, _still_text(self.steps[number], number, self.count), color=BETWEEN,
                fontsize=7.4 * SHARPNESS, family="monospace", va="top", parse_math=False, linespacing=1.35,
            )  # fmt: skip
        canvas.draw()
        return np.asarray(canvas.buffer_rgba()).copy()


def style(axes: Any, *, x: str = "", y: str = "", title: str = "") -> None:
    """Labels and frame of a graph, readable on a light and on a dark page."""
    axes.set_facecolor("none")
    axes.set_xlabel(x, color=BETWEEN, fontsize=8)
    axes.set_ylabel(y, color=BETWEEN, fontsize=8)
    axes.set_title(title, color=BETWEEN, fontsize=8.5, loc="left", pad=3)
    axes.tick_params(colors=BETWEEN, labelsize=7.5, length=2.5)
    for spine in axes.spines.values():
        spine.set_color(BETWEEN)
        spine.set_linewidth(0.6)


def moving(axes: Any, marks: str, **how: Any) -> Any:
    """A line or markers without points yet, drawn again at each step."""
    return axes.plot([], [], marks, animated=True, **how)[0]


def code_html(line: Line) -> str:
    """The lines around the one that runs, which is marked."""
    text = file_lines(line.path)
    first, last = line.first, line.last
    while first > max(1, line.first - _AROUND) and not text[first - 1].startswith("def "):
        first -= 1
    while last < min(len(text), line.last + _AROUND) and text[last : last + 2] != ("", ""):
        last += 1
    shown = textwrap.dedent("\n".join(text[first - 1 : last])).splitlines()
    rows = []
    for number, code in enumerate(shown, first):
        tag = Markup("mark") if line.first <= number <= line.last else Markup("div")
        rows.append(Markup("<{}><i>{:4d} </i>{}</{}>").format(tag, number, code, tag))
    return str(Markup('<p class="gsnb-stepper-place">{}</p>').format(line.place) + Markup("").join(rows))


def text_of(value: Any, digits: int = 4) -> str:
    """A value as the numbers of a step show it."""
    if isinstance(value, torch.Tensor):
        if value.ndim == 0:
            return text_of(value.item(), digits)
        return "(" + ", ".join(text_of(v, digits) for v in value) + ")"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.{digits}g}".replace("-", "−")
    return str(value).replace("-", "−") if isinstance(value, int) else str(value)


def _still_text(step: Step, number: int, count: int) -> str:
    rows = [step.heads, *step.numbers] if step.heads else list(step.numbers)
    columns = max(map(len, rows), default=0)
    wide = [max((len(row[k]) for row in rows if k < len(row)), default=0) for k in range(columns)]
    table = ["  ".join(cell.ljust(wide[k]) for k, cell in enumerate(row)).rstrip()[:62] for row in rows]
    title = textwrap.fill(f"{number + 1} of {count}: {step.title}", 62)
    code = textwrap.fill(step.line.text, 62, initial_indent="> ", subsequent_indent="  ")
    return "\n".join([title, "", step.line.place.split("/", 1)[1], code, "", *table])


def _palette_png(rgba: np.ndarray) -> bytes:
    """128 colours: a quarter of the size, for a picture that a notebook stores."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(rgba).quantize(128, method=Image.Quantize.FASTOCTREE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
