"""A panel for a notebook: controls beside one picture that a plain function makes from their
values.

The picture can be touched: a function turns a drag over it into new values of the controls.
"""

import html
import math
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ...drawing.pictures import Picture
from ...errors import UnknownNameError
from ..display import Bundle, ClickImage, LiveOutput, LostNotice, Stroke, with_picture

Number = float | int


@dataclass(frozen=True, kw_only=True)
class Slider:
    """A number between two ends."""

    value: Number
    low: Number
    high: Number
    step: Number
    """Distance between two positions, or between their base-10 logarithms with ``log``. An int:
    whole numbers."""
    label: str
    log: bool = False
    readout: str = ".2f"
    """Format of the number beside the slider."""
    tip: str = ""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One of several words."""

    value: str
    options: Sequence[str]
    label: str


@dataclass(frozen=True, kw_only=True)
class Switch:
    """On or off."""

    value: bool
    label: str


Control = Slider | Choice | Switch
Drawn = tuple[Picture, str]
"""A picture and a line of text under the controls."""
Touch = Callable[[Stroke, dict[str, Any]], Mapping[str, Any]]
"""A drag in pixels of the picture, and the controls' values when it began -> the values that
change."""


class Panel(LiveOutput):
    """Shows ``draw(**values)`` and draws again when a control moves. The last line of a cell shows
    it.

    ``draw`` is called in the thread in which the notebook handles the control, one call at a time,
    always with the newest values. If it raises, the error is shown instead of the text, and the
    last picture stays.

    Args:
        draw: Control values by name -> picture and text.
        controls: Name -> control, from top to bottom.
        buttons: Label -> function; the picture is drawn again after it.
        name: Part of the CSS classes: ``gsnb-NAME`` for the panel, ``gsnb-NAME-image``,
            ``gsnb-NAME-text``, and one for every control.
        kind: "jpeg" for photographs, "png" for drawings.
        text: What the panel is; shown where neither widgets nor pictures can be shown, and with the
            line of text under the controls the picture's description for screen readers.
        touch: What a drag over the picture changes; the sliders move along. Without it the picture
            is only looked at.
    """

    def __init__(
        self,
        draw: Callable[..., Drawn],
        controls: Mapping[str, Control],
        *,
        buttons: Mapping[str, Callable[[], Any]] | None = None,
        name: str = "panel",
        kind: Literal["jpeg", "png"] = "jpeg",
        text: str = "Panel",
        touch: Touch | None = None,
    ):
        self.draw = draw
        self.name = name
        self.kind = kind
        self.text = text
        self.lock = threading.RLock()
        self._quiet = False
        self._touch = touch
        self._stroke = 0
        self._values_at_start = dict[str, Any]()
        self._picture: Picture = np.full((1, 1, 3), 255, np.uint8)
        self._build(controls, dict(buttons or {}))
        self.redraw()

    @property
    def values(self) -> dict[str, Any]:
        """Values of the controls."""
        return {name: control.value for name, control in self.controls.items()}

    def set(self, **values: Any) -> "Panel":
        """Move several controls with one redraw."""
        unknown = sorted(set(values) - set(self.controls))
        if unknown:
            raise UnknownNameError(f"no controls {unknown}; known: {', '.join(self.controls)}")
        self._quiet = True
        try:
            for name, value in values.items():
                self.controls[name].value = value
        finally:
            self._quiet = False
        self.redraw()
        return self

    def drag(
        self,
        start: tuple[Number, Number],
        *way: tuple[Number, Number],
    ) -> "Panel":
        """Drag the picture from a point over others, (u, v) in pixels of ``picture()``; with only a
        start, a click."""
        for point in (start, *way):
            self._on_stroke(
                Stroke(
                    number=self._stroke + (point is start),
                    start=start,
                    now=point,
                )
            )
        return self

    def press(self, label: str) -> "Panel":
        """Press a button."""
        if label not in self.buttons:
            raise UnknownNameError(f"no button {label!r}; known: {', '.join(self.buttons)}")
        self.buttons[label].click()
        return self

    def picture(self) -> Picture:
        """What is shown."""
        return self._picture

    def redraw(self) -> None:
        """Call ``draw`` with the present values, and show the result."""
        with self.lock:
            try:
                self._picture, words = self.draw(**self.values)
            except Exception as e:  # a traceback in a callback is seen nowhere
                self._show_error(e)
                return
            self.image.width = self._picture.shape[1]
            self.image.alt = (
                f"{self.text}: {_spoken(words.partition('<table')[0]) or _spoken(words)}"
            )
            self.image.show(self._picture)
            self.caption.value = words

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self.redraw()
        return with_picture(
            self.widget._repr_mimebundle_(**kwargs),
            self._picture,
            self.text,
            alt=self.image.alt,
        )

    def _build(
        self,
        controls: Mapping[str, Control],
        buttons: dict[str, Callable[[], Any]],
    ) -> None:
        import ipywidgets as w

        self.controls = {name: _widget(control) for name, control in controls.items()}
        for name, control in self.controls.items():
            control.add_class(f"gsnb-{self.name}-{name}")
            control.observe(self._on_change, names="value")
        self.buttons = {
            label: w.Button(description=label, layout=w.Layout(width="auto")) for label in buttons
        }
        for label, button in self.buttons.items():
            button.add_class(f"gsnb-{self.name}-{label.lower().replace(' ', '-')}")
            button.on_click(lambda _, act=buttons[label]: self._on_click(act))
        self.image = ClickImage(
            format=self.kind, alt=self.text, touch="stroke" if self._touch else ""
        )
        self.image.add_class(f"gsnb-{self.name}-image")
        self.image.on_stroke(self._on_stroke)
        self.caption = w.HTML()
        self.caption.add_class(f"gsnb-{self.name}-text")
        self.widget = picture_and_controls(
            self.image,
            list(self.controls.values()),
            list(self.buttons.values()),
            self.caption,
        )
        self.widget.add_class(f"gsnb-{self.name}")

    def _show_error(self, error: Exception) -> None:
        message = html.escape(f"{type(error).__name__}: {error}")
        self.caption.value = f'<span style="color:#b3261e">{message}</span>'

    def _on_change(self, _change: Any) -> None:
        if not self._quiet:
            self.redraw()

    def _on_stroke(self, stroke: Stroke) -> None:
        with self.lock:
            if stroke.number != self._stroke:
                self._stroke = stroke.number
                self._values_at_start = self.values
            if self._touch is not None:
                try:
                    changes = self._touch(stroke, self._values_at_start)
                except ValueError as e:
                    self._show_error(e)
                    return
                if changes:
                    self.set(**{k: _on_step(self.controls[k], x) for k, x in changes.items()})

    def _on_click(self, act: Callable[[], Any]) -> None:
        with self.lock:
            act()
            self.redraw()


def picture_and_controls(
    picture: Any,
    controls: Sequence[Any],
    buttons: Sequence[Any],
    words: Any,
) -> Any:
    """A picture with its controls beside it, or below it in columns where the page is too
    narrow."""
    import ipywidgets as w

    wrap_layout = w.Layout(flex_flow="row wrap")
    parts = [
        w.HBox(list(controls), layout=wrap_layout),
        w.HBox(list(buttons), layout=wrap_layout),
        words,
        LostNotice(),
    ]
    side = w.VBox(parts, layout=w.Layout(flex="1 1 310px", min_width="310px"))
    row = w.Layout(flex_flow="row wrap", align_items="flex-start", grid_gap="8px")
    return w.HBox([picture, side], layout=row)


def _on_step(control: Any, value: Any) -> Any:
    """The nearest value that a slider can show."""
    if not isinstance(value, Number) or isinstance(value, bool) or not hasattr(control, "step"):
        return value
    nearest = control.min + round((value - control.min) / control.step) * control.step
    return type(control.value)(round(min(max(nearest, control.min), control.max), 6))


def _spoken(words: str) -> str:
    """HTML as plain text."""
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", words)).split())


def _widget(control: Control) -> Any:
    import ipywidgets as w

    place = {"style": {"description_width": "110px"}, "layout": w.Layout(width="300px")}
    if isinstance(control, Choice):
        return w.Dropdown(
            options=list(control.options), value=control.value, description=control.label, **place
        )
    if isinstance(control, Switch):
        return w.Checkbox(value=control.value, description=control.label, **place)
    c = control
    common = {
        "value": c.value,
        "step": c.step,
        "description": c.label,
        "tooltip": c.tip,
        "continuous_update": True,
    }
    if c.log:
        return w.FloatLogSlider(
            min=math.log10(c.low),
            max=math.log10(c.high),
            base=10,
            readout_format=c.readout,
            **common,
            **place,
        )
    if isinstance(c.step, int) and isinstance(c.value, int):
        return w.IntSlider(min=c.low, max=c.high, **common, **place)
    return w.FloatSlider(
        min=c.low,
        max=c.high,
        readout_format=c.readout,
        **common,
        **place,
    )
