"""Lines of a plain function as they ran: their text, their values, nested functions, what is restored afterwards."""

import sys

import pytest
import torch

from gsfusion_nb.seeding.quadtree import luma_variance
from gsfusion_nb.tsdf.volume import corner_weights
from gsfusion_nb.viz.steppers.recording import file_lines, record, statement


def test_lines_carry_the_values_after_them_and_the_text_of_the_file():
    rgb = torch.arange(27, dtype=torch.uint8).view(3, 3, 3)
    recording = record(lambda: luma_variance(rgb), {luma_variance: {"luma_variance": ("r", "g + b", "unknown")}})
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


def test_a_statement_over_several_lines_is_one(tmp_path):
    file = tmp_path / "a.py"
    text = "def f(a):\n    while (\n        a\n    ):\n        b = [\n            a,\n        ]\n    return b\n"
    file.write_text(text)
    spans = [statement(str(file), n) for n in range(1, 9)]
    assert spans == [(1, 1), *[(2, 4)] * 3, *[(5, 7)] * 3, (8, 8)]
