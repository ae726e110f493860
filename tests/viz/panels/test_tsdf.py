"""A slice shows every voxel in its place; moving a camera changes nothing in the map, and measuring
does."""

import numpy as np
import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.drawing.pictures import LABEL_PX, to_uint8
from gsfusion_nb.drawing.shading import NOTHING
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.types import Camera, Frame
from gsfusion_nb.viz import tsdf_fill_panel
from gsfusion_nb.viz.panels.tsdf import (
    camera_handles,
    draw_camera,
    level_pose,
    slice_picture,
    slice_pixel,
)

VIEW = {"x_m": (0.0, 1.6), "y_m": (0.0, 0.8), "px_per_m": 100}


@pytest.fixture
def volume():
    """One block of 10 cm voxels at the origin; voxel (1, 2, 3) has D = -1, W = 5 and is green; (4,
    0, 3) has D = 1."""
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.1))
    volume.add_blocks(torch.tensor([[0, 0, 0]]))
    for (x, y, z), D, W, rgb in (
        ((1, 2, 3), -1.0, 5.0, (0.0, 1.0, 0.0)),
        ((4, 0, 3), 1.0, 10.0, (1.0, 0.0, 0.0)),
    ):
        n = 64 * x + 8 * y + z
        volume.D[0, n] = D
        volume.W[0, n] = W
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
    # another layer: nothing observed
    assert (slice_picture(volume, height_m=0.45, **VIEW).std(-1) == 0).all()


def test_weight_and_colour(volume):
    weight = slice_picture(volume, height_m=0.35, quantity="weight", max_weight=10, **VIEW)
    assert weight[75, 45].tolist() == [253, 231, 37]  # full: the last colour of viridis
    assert weight[55, 15].tolist() != weight[75, 45].tolist()
    colour = slice_picture(volume, height_m=0.35, quantity="colour", **VIEW)
    assert colour[55, 15].tolist() == [0, 255, 0]
    with pytest.raises(ValueError, match="one of distance, weight, colour, got 'depth'"):
        slice_picture(volume, quantity="depth")  # pyright: ignore[reportArgumentType]


def test_the_camera_is_drawn_where_it_stands():
    camera = Camera(
        width=20,
        height=10,
        fx=20.0,
        fy=20.0,
        cx=10.0,
        cy=5.0,
    )
    blank = np.zeros((252, 312, 3), np.uint8)
    image = draw_camera(blank, camera, level_pose(0.4, 0.4, 0.3, 0.0), reach_m=0.8)
    assert (blank == 0).all()
    orange = np.argwhere((image[..., 0] > 200) & (image[..., 1] > 100))
    u, v = slice_pixel(0.4, 0.4)
    assert orange[:, 1].min() >= u - 6  # nothing behind the camera
    assert orange[:, 1].max() == pytest.approx(u + 48, abs=2)
    assert abs(orange[:, 0].mean() - v) < 1.5  # the edges are symmetric about its row


CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=208.0,
    cx=160.0,
    cy=120.0,
)
SMALL = CAMERA.resized(160, 120)


def look(T_WC):
    """A flat wall 1.5 m ahead of wherever the camera stands."""
    size = (SMALL.height, SMALL.width)
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.full((*size, 3), 0.5),
        depth_m=torch.full(size, 1.5),
        camera=SMALL,
        T_WC=T_WC,
    )


def blue(picture):
    """Pixels of free space in the slice."""
    part = picture[26:276, :310].astype(int)
    return (part[..., 2] - part[..., 0] > 60).sum()


@pytest.fixture
def panel():
    return tsdf_fill_panel(
        TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0)), CAMERA, look
    )


def test_the_pose_is_rigid_upright_and_looks_along_its_heading():
    T = level_pose(1.0, 2.0, 1.5, 90.0, 30.0).double()
    assert T[:3, 3].tolist() == [1.0, 2.0, 1.5]
    assert T[:3, 2].tolist() == pytest.approx([0, 3**0.5 / 2, 0.5], abs=1e-6)  # towards +y and up
    assert T[:3, 0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)  # its right is +x
    assert T[2, 1] < 0  # its down is down
    assert torch.allclose(
        T[:3, :3] @ T[:3, :3].T,
        torch.eye(3, dtype=torch.float64),
        atol=1e-6,
    )
    assert float(torch.linalg.det(T[:3, :3])) == pytest.approx(1)


def test_only_measuring_fills_the_map(panel):
    empty = panel.picture()
    panel.set(heading_deg=30.0)
    assert "<b>0</b> blocks" in panel.caption.value
    panel.press("measure")
    assert "<b>0</b> blocks" not in panel.caption.value
    assert 'gsnb-fill-frames">1</b>' in panel.caption.value
    filled = panel.picture()
    assert blue(filled) > 200 > blue(empty)
    view = filled[-240:, -320:]
    assert view.mean() > 100  # the wall, lit
    panel.press("forget")
    assert "<b>0</b> blocks" in panel.caption.value
    nothing = to_uint8(torch.tensor(NOTHING)[None, None])
    assert (panel.picture()[-240:, -320:] == nothing).all()


def test_the_camera_is_dragged_in_the_slice_and_turned_by_its_handle(panel):
    panel.set(x_m=0.5, y_m=0.0, heading_deg=0.0)
    at = camera_handles(0.5, 0.0, 0.0)
    u = at["place"][0]
    v = at["place"][1] + LABEL_PX
    panel.drag(
        (u, v),
        (u + 10, v),
        (u - 30, v - 60),
    )
    assert (panel.values["x_m"], panel.values["y_m"]) == (
        0.0,
        1.0,
    )  # 60 pixels are a metre, y is up
    u, v = camera_handles(0.0, 1.0, 0.0)["heading"]
    panel.drag(
        (u, v + LABEL_PX),
        (slice_pixel(0.0, 1.6)[0], slice_pixel(0.0, 1.6)[1] + LABEL_PX),
    )
    assert panel.values["heading_deg"] == 90
    assert panel.values["x_m"] == 0.0
    before = panel.values
    panel.drag((5.0, 250.0), (50.0, 250.0))  # far from both handles
    assert panel.values == before
    panel.drag((400.0, 100.0), (420.0, 110.0))
    assert panel.values["heading_deg"] > 90
    assert panel.values["tilt_deg"] > 0
