"""Colour edges against depth edges."""

import numpy as np
import pytest

from gsfusion_nb.recordings.checkup.alignment import colour_contrast, depth_edges


def test_edges_belong_to_the_nearer_side():
    depth_m = np.full((6, 8), 4.0, np.float32)
    depth_m[2:5, 3:6] = 1.0
    expected = np.zeros((6, 8))
    expected[2:5, 3:6] = 1
    expected[3, 4] = 0
    assert np.array_equal(depth_edges(depth_m), expected)


def test_narrow_holes_beside_an_object_are_background():
    depth_m = np.full((1, 30), 4.0, np.float32)
    depth_m[0, 10:15] = 1.0
    depth_m[0, 15:20] = 0.0  # the part that the projector does not reach
    assert np.flatnonzero(depth_edges(depth_m)[0]).tolist() == [10, 14]
    depth_m[0, 15:29] = 0.0  # too wide to know
    assert np.flatnonzero(depth_edges(depth_m)[0]).tolist() == [10]


def test_a_slope_has_no_edges():
    depth_m = np.linspace(1, 3, 100, dtype=np.float32)[None].repeat(5, 0)
    assert depth_edges(depth_m).sum() == 0


def test_contrast_is_the_same_in_weak_light():
    image = np.full((60, 80), 40, np.uint8)
    image[:, 40:] = 200
    contrast = colour_contrast(image, image.shape)
    assert contrast[30, 39:41].min() == pytest.approx(4.0)
    assert contrast[:, :20].max() < 1e-3
    assert np.abs(contrast - colour_contrast(image // 2, image.shape)).max() < 0.6
