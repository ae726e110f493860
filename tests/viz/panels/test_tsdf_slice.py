"""A slice shows every voxel where it is, in the colour of its value."""

import numpy as np
import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.types import Camera
from gsfusion_nb.viz.panels.tsdf import distance_colours, draw_camera, slice_picture

VIEW = {"x_m": (0.0, 1.6), "y_m": (0.0, 0.8), "px_per_m": 100}


@pytest.fixture
def volume():
    """One block of 10 cm voxels at the origin; voxel (1, 2, 3) has D = -1, W = 5 and is green; (4, 0, 3) has D = 1."""
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.1))
    volume.add_blocks(torch.tensor([[0, 0, 0]]))
    for (x, y, z), D, W, rgb in (((1, 2, 3), -1.0, 5.0, (0.0, 1.0, 0.0)), ((4, 0, 3), 1.0, 10.0, (1.0, 0.0, 0.0))):
        n = 64 * x + 8 * y + z
        volume.D[0, n], volume.W[0, n] = D, W
        volume.rgb_planes[0, :, n] = torch.tensor(rgb)
    return volume


def test_x_goes_right_and_y_goes_up(volume):
    image = slice_picture(volume, height_m=0.35, **VIEW)
    assert image.shape == (80, 160, 3)
    seen = (image.max(-1) != image.min(-1)).astype(int)
    expected = np.zeros((80, 160), int)
    expected[50:60, 10:20] = 1  # voxel (1, 2): x 0.1..0.2, y 0.2..0.3
    expected[70:80, 40:50] = 1
    assert (seen == expected).all()
    assert image[55, 15].argmax() == 0  # behind is red
    assert image[75, 45].argmax() == 2  # free is blue
    assert (slice_picture(volume, height_m=0.45, **VIEW).std(-1) == 0).all()  # another layer: nothing observed


def test_weight_and_colour(volume):
    weight = slice_picture(volume, height_m=0.35, quantity="weight", max_weight=10, **VIEW)
    assert weight[75, 45].tolist() == [253, 231, 37]  # full: the last colour of viridis
    assert weight[55, 15].tolist() != weight[75, 45].tolist()
    colour = slice_picture(volume, height_m=0.35, quantity="colour", **VIEW)
    assert colour[55, 15].tolist() == [0, 255, 0]
    with pytest.raises(ValueError, match="one of distance, weight, colour, got 'depth'"):
        slice_picture(volume, quantity="depth")  # pyright: ignore[reportArgumentType]


def test_distance_colours_run_from_red_over_white_to_blue():
    row = distance_colours(np.array([[-3.0, -1.0, 0.0, 0.5, 1.0]], np.float32))[0].astype(int)
    assert row[0].tolist() == row[1].tolist() == [178, 34, 52]
    assert row[2].tolist() == [255, 255, 255]
    assert row[4].tolist() == [44, 98, 168]
    assert (row[3] == np.round((row[2] + row[4]) / 2 + 0.25)).all() or np.abs(row[3] - (row[2] + row[4]) / 2).max() <= 1


def test_the_camera_stands_where_it_is_and_looks_where_it_looks():
    camera = Camera(width=20, height=10, fx=20.0, fy=20.0, cx=10.0, cy=5.0)
    T = torch.eye(4)
    T[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along world x
    T[:3, 3] = torch.tensor([0.4, 0.4, 0.3])
    blank = np.zeros((80, 160, 3), np.uint8)
    image = draw_camera(blank, camera, T, reach_m=0.8, **VIEW)
    assert (blank == 0).all()
    orange = np.argwhere((image[..., 0] > 200) & (image[..., 1] > 100))
    assert orange[:, 1].min() >= 34  # nothing behind the camera at column 40
    assert orange[:, 1].max() == pytest.approx(120, abs=2)
    assert abs(orange[:, 0].mean() - 40) < 1.5  # the edges are symmetric about its row
