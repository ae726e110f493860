"""Recorded lines of a plain function, and the widget that steps through them."""

import base64
import sys

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.seeding.quadtree import luma_variance
from gsfusion_nb.tsdf.cells import corner_weights
from gsfusion_nb.viz import adam_stepper
from gsfusion_nb.viz.display import WIDGET_MIME
from gsfusion_nb.viz.steppers.recording import file_lines, record


def test_lines_carry_the_values_after_them_and_the_text_of_the_file():
    rgb = torch.arange(27, dtype=torch.uint8).view(3, 3, 3)
    recording = record(
        lambda: luma_variance(rgb), {luma_variance: {"luma_variance": ("r", "g + b", "unknown")}}
    )
    first, last = recording
    assert first.text.startswith("r, g, b = rgb.double()")
    assert first.text == file_lines(first.path)[first.first - 1].strip()
    assert first.place.startswith("gsfusion_nb/seeding/quadtree.py:")
    assert first["r"] == pytest.approx(rgb[..., 0].double().var(correction=0).item())
    assert "unknown" not in first.values
    assert last["return"] == recording.result
    with pytest.raises(ValueError, match="no line that ran"):
        recording.at("x = 1")


def test_the_trace_function_of_before_is_back_also_after_an_error():
    def fails():
        raise KeyError("here")

    before = sys.gettrace()
    with pytest.raises(KeyError):
        record(fails, {corner_weights: {"corner_weights": ()}})
    assert sys.gettrace() is before


@pytest.fixture(scope="module")
def stepper():
    return adam_stepper(before=1, after=1)


def test_any_step_can_be_shown(stepper):
    stepper.step = 10_000
    assert stepper.step == stepper.count - 1
    assert stepper.go_to(-2).step == stepper.count - 2
    shown = stepper.shown
    stepper.go_to(0)
    assert stepper.shown == shown + 1
    assert "<mark>" in stepper.code
    assert stepper.alt.startswith("Adam on a growing map")


def test_a_stored_notebook_keeps_some_steps_as_one_picture(stepper, monkeypatch):
    monkeypatch.setenv("GSNB_VIEW", "static")
    data, metadata = stepper._repr_mimebundle_()
    assert WIDGET_MIME not in data
    png = cv2.imdecode(
        np.frombuffer(base64.b64decode(data["image/png"]), np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert png is not None
    assert png.shape[2] == 4
    assert (png[..., 3] == 0).mean() > 0.3
    shown = metadata["image/png"]
    assert shown["width"] <= 1000
    assert "Adam on a growing map" in shown["alt"]
    assert stepper.steps[-1].title in shown["alt"]
    # a page writes the words as text: the left half of each third is the picture of its step
    last = shown["steps"][-1]
    assert last["title"] == stepper.steps[-1].title
    assert last["code"] == stepper.steps[-1].line.text
    assert last["numbers"][-1] == list(stepper.steps[-1].numbers[-1])
    height, width = png.shape[0] // len(shown["steps"]), png.shape[1] // 2
    picture = stepper.go_to(-1).picture()
    assert picture.shape[:2] == (height, width)
    drawn = png[-height:, :width, 3].astype(int)
    assert np.abs(drawn - picture[..., 3]).mean() < 4
    monkeypatch.delenv("GSNB_VIEW")
    monkeypatch.setenv("GSNB_SMOKE", "0")
    assert WIDGET_MIME in stepper._repr_mimebundle_()[0]
