"""The widget itself: where the buttons lead, what a stored notebook keeps, how much a step draws."""

import base64

import cv2
import numpy as np
import pytest

from gsfusion_nb.viz import adam_stepper
from gsfusion_nb.viz.display import WIDGET_MIME
from gsfusion_nb.viz.steppers.stepper import text_of


@pytest.fixture(scope="module")
def stepper():
    return adam_stepper(before=1, after=1)


def test_next_back_restart_and_any_number(stepper):
    stepper.restart()
    assert (stepper.back().step, stepper.next().step, stepper.next().step, stepper.back().step) == (0, 1, 2, 1)
    stepper.step = 10_000
    assert stepper.step == stepper.count - 1
    assert stepper.next().step == stepper.count - 1
    assert stepper.go_to(-2).step == stepper.count - 2
    assert stepper.find("A new row") > 3
    with pytest.raises(ValueError, match="no step"):
        stepper.find("nothing like this")
    shown = stepper.shown
    stepper.restart()
    assert stepper.shown == shown + 1
    assert "<mark>" in stepper.code
    assert stepper.alt.startswith("Adam on a growing map")


def test_a_step_draws_only_what_moves(stepper, monkeypatch):
    drawn = []
    whole = stepper._canvas.draw
    monkeypatch.setattr(stepper._canvas, "draw", lambda: drawn.append(1) or whole())
    pictures = [stepper.go_to(k).picture() for k in range(stepper.count)]
    assert drawn == []
    assert (pictures[0] != pictures[-1]).any()
    np.testing.assert_array_equal(stepper.go_to(0).picture(), pictures[0])  # nothing is left of later steps


def test_a_stored_notebook_keeps_some_steps_as_one_picture(stepper, monkeypatch):
    monkeypatch.setenv("GSNB_VIEW", "static")
    data, metadata = stepper._repr_mimebundle_()
    assert WIDGET_MIME not in data
    png = cv2.imdecode(np.frombuffer(base64.b64decode(data["image/png"]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert png is not None
    assert png.shape[2] == 4
    assert (png[..., 3] == 0).mean() > 0.3
    shown = metadata["image/png"]
    assert shown["width"] <= 1000
    assert "Adam on a growing map" in shown["alt"]
    assert all(stepper.steps[i].title in shown["alt"] for i in stepper._stills)
    monkeypatch.delenv("GSNB_VIEW")
    monkeypatch.setenv("GSNB_SMOKE", "0")
    assert WIDGET_MIME in stepper._repr_mimebundle_()[0]


def test_numbers_are_short():
    assert text_of(-0.123456) == "−0.1235"
    assert (text_of(True), text_of(-3), text_of((1.0, 2))) == ("yes", "−3", "(1.0, 2)")
