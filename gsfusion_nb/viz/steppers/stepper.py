"""The widget of a stepper: press Next, and see the line that runs, a picture of it, and its
numbers."""

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

from ...drawing.curves import BETWEEN, figure_picture
from ...drawing.encoding import encode_palette, encode_rgba
from ...drawing.page import html_table
from ...errors import ArgumentError
from ...viewer.front_end import source
from ..display import ROOM, Bundle, LiveOutput, synced, with_stored
from .recording import Line, file_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AROUND = 8
"""Lines of code that are shown before and after the one that runs."""
SHARPNESS = 1.5
"""Pixels of the picture for each pixel on screen."""


@dataclass(frozen=True, eq=False)
class Step:
    """What one press of Next shows."""

    line: Line
    title: str
    """What happens, in one or two sentences."""
    numbers: Sequence[Sequence[str]]
    """Rows of a table."""
    scene: Any
    """What the drawing needs."""
    heads: Sequence[str] = ()


Draw = Callable[["Figure", Any], None]
"""Draws the scene of a step into an empty figure."""


class Stepper(LiveOutput, anywidget.AnyWidget):
    """Shows one step at a time: its line of code, a picture, its numbers. Buttons, arrow keys and a
    slider move.

    ``step`` is the number of the step, from 0; ``steps`` are all of them.

    Args:
        steps: What is shown.
        draw: Makes the picture of a step.
        name: Part of the CSS class: ``gsnb-stepper-NAME``.
        label: What is stepped through, for screen readers.
        size: Width and height of the picture on screen, pixels.
        stills: Numbers of the steps that a stored notebook shows, from 0; by default three, evenly
            spread.
    """

    _esm = source(ROOM, "steppers/stepper.js")
    _css = source(ROOM, "steppers/stepper.css")

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
        draw: Draw,
        *,
        name: str,
        label: str,
        size: tuple[int, int] = (450, 340),
        stills: Sequence[int] | None = None,
    ):
        from matplotlib.figure import Figure

        if not steps:
            raise ArgumentError(f"{label}: there is no step to show")
        super().__init__(
            count=len(steps),
            name=name,
            label=label,
            width=size[0],
        )
        self.steps = tuple(steps)
        thirds = sorted({round(i * (len(steps) - 1) / 3) for i in range(1, 4)})
        self._stills = [self.steps[k] for k in (thirds if stills is None else stills)]
        self._draw = draw
        self._lock = threading.RLock()  # the page's messages may be handled in another thread
        self._figure = Figure(
            figsize=(size[0] / 100, size[1] / 100),
            dpi=100 * SHARPNESS,
            facecolor="none",
        )
        self.observe(lambda _: self._show(), "step")
        self._show()

    @t.validate("step")
    def _inside(self, proposal: Any) -> int:
        return min(max(proposal["value"], 0), self.count - 1)

    def go_to(self, step: int) -> "Stepper":
        """Show a step, from 0; negative numbers count from the end."""
        self.step = step if step >= 0 else self.count + step
        return self

    def picture(self) -> np.ndarray:
        """The picture of the present step, with its transparent ground. [H, W, 4] bytes"""
        return self._draw_step(self.steps[self.step])

    def _draw_step(self, step: Step) -> np.ndarray:
        with self._lock:
            self._figure.clear()
            self._draw(self._figure, step.scene)
            return figure_picture(self._figure, channels=4)

    def _show(self) -> None:
        with self._lock, self.hold_sync():
            current = self.steps[self.step]
            self.png = encode_rgba(self._draw_step(current))
            self.alt = f"{self.label}, step {self.step + 1} of {self.count}: {current.title}"
            self.title = str(Markup("{}").format(current.title))
            self.code = code_html(current.line)
            self.numbers = html_table(current.numbers, heads=current.heads)
            self.shown += 1

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        picture = self._still_picture(self._stills)
        titles = "; ".join(step.title for step in self._stills)
        alt = f"{self.label}, steps of {self.count}: {titles}"
        words = {
            "width": round(picture.shape[1] / SHARPNESS),
            "alt": alt,
            "steps": [still_words(step) for step in self._stills],
        }
        text = f"{self.label}: {self.count} steps"
        return with_stored(
            super()._repr_mimebundle_(**kwargs), "image/png", encode_palette(picture), text, words
        )

    def _still_picture(self, steps: Sequence[Step]) -> np.ndarray:
        """Some steps of equal height below each other: the picture in the left half, in the right
        one its title, line and numbers (``still_words``). What a notebook stores."""
        from matplotlib.figure import Figure

        pictures = [self._draw_step(step) for step in steps]
        height, width = pictures[0].shape[:2]
        figure = Figure(
            figsize=(2 * width / 100, height * len(steps) / 100),
            dpi=100,
            facecolor="none",
        )
        for k, (picture, step) in enumerate(zip(pictures, steps, strict=True)):
            figure.figimage(
                picture,
                0,
                height * (len(steps) - 1 - k),
                origin="upper",
            )
            rows = [
                [step.title],
                [step.line.place],
                ["> " + step.line.text],
                [],
                step.heads,
                *step.numbers,
            ]
            words = "\n".join(textwrap.fill("   ".join(row), 62) for row in rows)
            figure.text(
                0.51,
                1 - (k + 0.04) / len(steps),
                words,
                color=BETWEEN,
                fontsize=7.4 * SHARPNESS,
                family="monospace",
                va="top",
                parse_math=False,
                linespacing=1.35,
            )
        return figure_picture(figure, channels=4)


def still_words(step: Step) -> dict[str, Any]:
    """What stands to the right of a step's picture in a stored still: a page that is made of the
    notebook writes it as text."""
    return {
        "title": step.title,
        "place": step.line.place,
        "code": step.line.text,
        "numbers": [list(row) for row in (step.heads, *step.numbers) if row],
    }


def code_html(line: Line) -> str:
    """The lines around the one that runs, which is marked."""
    text = file_lines(line.path)
    first = line.first
    last = line.last
    while first > max(1, line.first - _AROUND) and not text[first - 1].startswith("def "):
        first -= 1
    while last < min(len(text), line.last + _AROUND) and text[last : last + 2] != ("", ""):
        last += 1
    excerpt = textwrap.dedent("\n".join(text[first - 1 : last])).splitlines()
    rows = []
    for number, code in enumerate(excerpt, first):
        tag = Markup("mark") if line.first <= number <= line.last else Markup("div")
        rows.append(Markup("<{}><i>{:4d} </i>{}</{}>").format(tag, number, code, tag))
    return str(
        Markup('<p class="gsnb-stepper-place">{}</p>').format(line.place) + Markup("").join(rows)
    )


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
