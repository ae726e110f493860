"""Little graphs: where the line runs, gaps, and short numbers."""

import math

import numpy as np
import pytest

from gsfusion_nb.drawing.curves import PALETTE, small_curves

BLUE = np.array([int(PALETTE[0][i : i + 2], 16) for i in (1, 3, 5)])


def line_columns(image):
    return np.nonzero((np.abs(image.astype(int) - BLUE).sum(-1) < 60).any(0))[0]


def test_the_line_rises_and_fills_as_much_as_is_done():
    image = small_curves({"a": [0, 1, 2, 3, 4]}, n_x=9, width=200, height=80, scale=1)
    columns = line_columns(image)
    assert columns.min() == pytest.approx(52, abs=3)
    assert columns.max() == pytest.approx(52 + (190 - 52) / 2, abs=4)
    rows = [
        np.nonzero(np.abs(image[:, c].astype(int) - BLUE).sum(-1) < 60)[0].mean() for c in (columns[3], columns[-4])
    ]
    assert rows[0] > rows[1] + 20


def test_nan_leaves_a_gap():
    values = [1.0] * 10 + [math.nan] * 10 + [2.0] * 10
    columns = line_columns(small_curves({"a": values}, n_x=30, width=200, height=80, scale=1))
    assert np.diff(columns).max() > 30
