"""A panel without a browser: controls call the function, buttons act, errors stand in the text."""

import cv2
import numpy as np
import pytest

from gsfusion_nb.viz.display import WIDGET_MIME
from gsfusion_nb.viz.panels.panel import Choice, Panel, Slider, Switch


def shown(panel):
    return np.asarray(cv2.imdecode(np.frombuffer(panel.image.value, np.uint8), cv2.IMREAD_COLOR))[
        ..., ::-1
    ]


@pytest.fixture
def panel():
    """A grey picture as bright as the slider says; it refuses 13."""
    calls = []

    def draw(*, level, word, flip):
        calls.append((level, word, flip))
        if level == 13:
            raise ValueError("13 brings <bad> luck")
        return np.full(
            (4, 6, 3),
            255 - level if flip else level,
            np.uint8,
        ), f"{word} {level}"

    controls = {
        "level": Slider(
            value=100,
            low=0,
            high=255,
            step=1,
            label="level",
        ),
        "word": Choice(value="grey", options=("grey", "gray"), label="word"),
        "flip": Switch(value=False, label="flip"),
    }
    panel = Panel(
        draw, controls, buttons={"brighter now": lambda: more(panel)}, kind="png", name="test"
    )
    panel.calls = calls  # pyright: ignore[reportAttributeAccessIssue]
    return panel


def more(panel):
    panel._quiet = True
    panel.controls["level"].value += 50
    panel._quiet = False


def test_a_control_redraws_picture_and_text(panel):
    assert (shown(panel) == 100).all()
    panel.controls["level"].value = 7
    assert (shown(panel) == 7).all()
    assert panel.caption.value == "grey 7"
    panel.controls["flip"].value = True
    panel.controls["word"].value = "gray"
    assert (panel.picture() == 248).all()
    assert panel.caption.value == "gray 7"
    assert (panel.image.width, panel.image.touch) == (6, "")


def test_set_redraws_once_and_knows_its_names(panel):
    n = len(panel.calls)
    assert panel.set(level=20, word="gray") is panel
    assert panel.calls[n:] == [(20, "gray", False)]
    with pytest.raises(KeyError, match=r"no controls \['lvel'\]; known: level, word, flip"):
        panel.set(lvel=1)


def test_an_error_is_shown_and_the_picture_stays(panel):
    panel.controls["level"].value = 13
    assert "ValueError: 13 brings &lt;bad&gt; luck" in panel.caption.value
    assert (shown(panel) == 100).all()
    panel.controls["level"].value = 14
    assert panel.caption.value == "grey 14"


def test_stored_and_live_outputs(panel, monkeypatch):
    for name in ("GSNB_VIEW", "GSNB_SMOKE"):
        monkeypatch.delenv(name, raising=False)
    live = set(panel._repr_mimebundle_()[0])
    assert {WIDGET_MIME, "text/plain"} <= live
    assert live & {"image/jpeg", "image/png"}
    monkeypatch.setenv("GSNB_VIEW", "static")
    assert WIDGET_MIME not in panel._repr_mimebundle_()[0]


def test_a_drag_moves_sliders_from_where_they_were_when_it_began():
    def touch(stroke, values):
        du, dv = stroke.moved
        return {"level": values["level"] + du, "flip": dv > 0}

    def draw(*, level, flip):
        return np.full((4, 6, 3), level, np.uint8), f"<b>grey</b>&nbsp;{level}, {flip}"

    controls = {
        "level": Slider(
            value=10,
            low=0,
            high=40,
            step=2,
            label="level",
        ),
        "flip": Switch(value=False, label="f"),
    }
    panel = Panel(draw, controls, touch=touch, text="A grey")
    assert panel.image.touch == "stroke"
    assert panel.image.alt == "A grey: grey 10, False"
    panel.drag((1.0, 1.0), (4.0, 1.0), (5.2, 2.0))
    assert panel.values == {"level": 14, "flip": True}  # from 10 by 4.2, to the slider's next step
    panel.drag((0.0, 0.0), (90.0, 0.0))
    assert panel.values == {"level": 40, "flip": False}  # the end of the slider
    assert panel.image.alt == "A grey: grey 40, False"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("<p>3 of 4</p><table><td>1</td></table>", "3 of 4"),
        ("<table><td>7 cm</td></table>", "7 cm"),
    ],
)
def test_a_table_is_spoken_only_where_there_is_nothing_else(words, said):
    def draw():
        return np.zeros((4, 6, 3), np.uint8), words

    assert Panel(draw, {}, text="A grey").image.alt == f"A grey: {said}"
