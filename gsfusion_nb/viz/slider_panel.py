"""A picture that follows sliders: any function from numbers to a picture becomes a panel."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

from .display import with_picture
from .figures import Picture, encode_jpeg

Control = tuple[float | int, float | int, float | int] | Sequence[str]
"""(low, high, start) of a slider, or the words of a menu, the first of which is the start."""


class SliderPanel:
    """Sliders and menus beside the picture that ``function`` makes of them; the last line of a cell shows it.

    Args:
        function: Called with one keyword per control. It returns a picture, or a picture and a caption in HTML.
        controls: Name -> (low, high, start), or a list of words. Whole numbers make a slider of whole numbers.
        labels: Name -> what stands beside the slider, with its unit; the name itself by default.
        width: Of the picture on screen, pixels.
    """

    def __init__(
        self,
        function: Callable[..., Picture | tuple[Picture, str]],
        controls: dict[str, Control],
        *,
        labels: dict[str, str] | None = None,
        width: int | None = None,
    ):
        self._function = function
        self._lock = threading.Lock()  # callbacks may come from another thread than the cells
        self._quiet = False
        self._build(controls, labels or {}, width)
        self._redraw()

    @property
    def values(self) -> dict[str, Any]:
        """What the controls say now."""
        return {name: control.value for name, control in self.controls.items()}

    def set(self, **values: Any) -> "SliderPanel":
        """Move controls, several at once with one redraw.

        Raises:
            KeyError: there is no such control.
        """
        unknown = sorted(set(values) - set(self.controls))
        if unknown:
            raise KeyError(f"no control {unknown[0]!r}; known: {', '.join(self.controls)}")
        self._quiet = True
        try:
            for name, value in values.items():
                self.controls[name].value = value
        finally:
            self._quiet = False
        self._redraw()
        return self

    def picture(self) -> Picture:
        """What the function makes of the present values."""
        return self._evaluate()[0]

    def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, Any]:
        words = ", ".join(f"{name}={value}" for name, value in self.values.items())
        return with_picture(self.widget._repr_mimebundle_(**kwargs), self.picture(), f"SliderPanel({words})")

    def _evaluate(self) -> tuple[Picture, str]:
        result = self._function(**self.values)
        return result if isinstance(result, tuple) else (result, "")

    def _build(self, controls: dict[str, Control], labels: dict[str, str], width: int | None) -> None:
        import ipywidgets as w

        style, wide = {"description_width": "130px"}, w.Layout(width="390px")
        self.controls: dict[str, Any] = {}
        for name, choice in controls.items():
            common: Any = {"description": labels.get(name, name), "style": style, "layout": wide}
            if any(isinstance(c, str) for c in choice):
                control = w.Dropdown(options=list(choice), **common)
            else:
                low, high, start = choice
                whole = all(isinstance(c, int) for c in choice)
                make, step = (w.IntSlider, 1) if whole else (w.FloatSlider, _step(float(low), float(high)))  # pyright: ignore[reportArgumentType]
                control = make(value=start, min=low, max=high, step=step, **common)
            control.add_class(f"gsnb-panel-{name}")
            control.observe(self._changed, "value")
            self.controls[name] = control
        size = {"width": f"{width}px"} if width else {}
        self.image = w.Image(format="jpeg", layout=w.Layout(max_width="100%", **size))
        self.image.add_class("gsnb-panel-image")
        self.caption = w.HTML()
        side = w.VBox([*self.controls.values(), self.caption], layout=w.Layout(margin="0 0 0 12px"))
        self.widget = w.HBox([self.image, side], layout=w.Layout(flex_flow="row wrap", align_items="flex-start"))
        self.widget.add_class("gsnb-panel")

    def _changed(self, _change: Any) -> None:
        if not self._quiet:
            self._redraw()

    def _redraw(self) -> None:
        with self._lock:
            picture, caption = self._evaluate()
            self.image.value, self.caption.value = encode_jpeg(picture, 92), caption


def _step(low: float, high: float) -> float:
    """A round step of about a hundredth of the range."""
    for step in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
        if (high - low) / step <= 200:
            return step
    return 1.0
