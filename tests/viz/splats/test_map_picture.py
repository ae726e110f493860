"""The Gaussian map as a picture: colours where the Gaussians are, in every way of showing it."""

from typing import get_args

import numpy as np
import pytest
import torch

from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.types import Camera
from gsfusion_nb.viz import draw_gaussians, orbit_camera
from gsfusion_nb.viz.splats.map_picture import SHOWS, Show

CAMERA = Camera(width=161, height=121, fx=120.0, fy=120.0, cx=80.5, cy=60.5)
LEFT, RIGHT = (60, 50), (60, 110)  # row, column of the two Gaussians seen from -y: 0.5 m aside at 2 m is 30 px


def test_red_left_green_right_seen_from_minus_y(model):
    T = orbit_camera((0, 0, 0), -90, 0, 2.0)
    image = draw_gaussians(model.params, CAMERA, T)
    assert image.shape == (121, 161, 3)
    assert image.dtype == np.uint8
    assert image[LEFT].argmax() == 0
    assert image[RIGHT].argmax() == 1
    behind = draw_gaussians(model.params, CAMERA, orbit_camera((0, 0, 0), 90, 0, 2.0))
    assert behind[LEFT].argmax() == 1
    assert image[5, 80].max() == 0  # nothing there


def test_every_way_of_showing_differs_and_leaves_the_map_alone(model):
    T = orbit_camera((0, 0, 0), -90, 0, 2.0)
    before = [t.clone() for t in vars(model.params).values()]
    images = [draw_gaussians(model.params, CAMERA, T, show, labels=model.birth_frame) for show in get_args(Show)]
    assert len({image.tobytes() for image in images}) == len(SHOWS)
    assert all((a == b).all() for a, b in zip(before, vars(model.params).values(), strict=True))


def test_depth_and_opacity(model):
    T = orbit_camera((0, 0, 0), -60, 0, 2.0)  # the right one is nearer now
    opacity = draw_gaussians(model.params, CAMERA, T, "opacity")
    row, column = np.unravel_index(opacity[:100, :, 0].argmax(), (100, 161))
    assert opacity[row, column].tolist() == [opacity[row, column, 0]] * 3
    assert opacity[row, column, 0] > 230
    depth = draw_gaussians(model.params, CAMERA, T, "depth")
    far, near = (np.abs(depth[:100].astype(int) - c).max(-1) < 40 for c in ((122, 4, 3), (48, 18, 59)))
    assert np.nonzero(far)[1].max() < 80 < np.nonzero(near)[1].min()


def test_labels_decide_the_colour(model):
    T = orbit_camera((0, 0, 0), -90, 0, 2.0)
    image = draw_gaussians(model.params, CAMERA, T, "first-seen frame", labels=model.birth_frame).astype(int)
    assert image[RIGHT][1] > 150 > 100 > image[LEFT][1]  # viridis: early dark purple, late yellow
    with pytest.raises(ValueError, match="needs labels"):
        draw_gaussians(model.params, CAMERA, T, "quadtree level")
    with pytest.raises(ValueError, match="labels must be"):
        draw_gaussians(model.params, CAMERA, T, "quadtree level", labels=torch.zeros(3, dtype=torch.int32))


def test_cutting_away_hides_the_nearer_one(model):
    T = orbit_camera((0, 0, 0), 0, 0, 2.0)  # from +x: green in front of red
    assert draw_gaussians(model.params, CAMERA, T)[60, 80].argmax() == 1
    assert draw_gaussians(model.params, CAMERA, T, cut_m=2.0)[60, 80].argmax() == 0
    assert draw_gaussians(model.params, CAMERA, T, cut_m=9.0).max() == 0


@pytest.mark.parametrize("show", SHOWS)
def test_an_empty_map_is_drawn(show):
    model = GaussianModel(sh_degree=0)
    image = draw_gaussians(model.params, CAMERA, torch.eye(4), show, labels=model.tag)
    assert image.shape == (121, 161, 3)


def test_tiny_pictures_have_no_room_for_a_scale(model):
    tiny = CAMERA.resized(20, 15)
    assert draw_gaussians(model.params, tiny, orbit_camera((0, 0, 0), -90, 0, 2.0), "opacity").shape == (15, 20, 3)
