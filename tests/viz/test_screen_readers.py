"""Every picture of a panel or live view has words, every control a name, and what can be dragged
has sliders too."""

import ipywidgets as w
import numpy as np
import pytest

from gsfusion_nb.types import Camera
from gsfusion_nb.viz import LiveLoop, LiveMapper, amdahl_panel, one_gaussian_panel
from gsfusion_nb.viz.display import ClickImage, LostNotice

CAMERA = Camera(
    width=48,
    height=36,
    fx=40.0,
    fy=40.0,
    cx=24.0,
    cy=18.0,
)
MAKERS = {
    "one Gaussian": lambda _: one_gaussian_panel(CAMERA),
    "amdahl": lambda _: amdahl_panel({"seed": 0.1, "optimise": 0.3}),
    "loop": lambda _: LiveLoop(
        lambda: iter([1]),
        lambda: np.zeros((36, 48, 3), np.uint8),
        {"loss": []},
        n_steps=1,
    ),
    "mapper": lambda make_run: LiveMapper(make_run()),
}


def widgets_of(widget):
    """The widget and all that it contains."""
    yield widget
    for child in getattr(widget, "children", ()):
        yield from widgets_of(child)


@pytest.mark.parametrize("name", MAKERS)
def test_pictures_have_words_and_controls_have_names(name, make_run):
    panel = MAKERS[name](make_run)
    every = list(widgets_of(panel.widget))
    assert not [x for x in every if isinstance(x, w.Image)], (
        "a plain Image has no words for screen readers"
    )
    for picture in (x for x in every if isinstance(x, ClickImage)):
        assert len(picture.alt) > 8, picture
    for control in (
        x for x in every if hasattr(x, "description") and not isinstance(x, w.HTML | w.IntProgress)
    ):
        assert control.description or control.tooltip, control
    assert sum(isinstance(x, LostNotice) for x in every) == 1
    data, words = panel._repr_mimebundle_()
    assert all(words[kind]["alt"] for kind in data if kind.startswith("image/"))
    touched = [x for x in every if isinstance(x, ClickImage) and x.touch == "stroke"]
    assert sum(isinstance(x, w.IntSlider | w.FloatSlider) for x in every) >= 2 or not touched
