"""Points of a frame from other poses; the true repair makes two frames of a recording agree."""

import re

import numpy as np
import pytest
import torch

from gsfusion_nb.data import tum
from gsfusion_nb.data.room.hand_held import HandHeld, write_hand_held
from gsfusion_nb.geometry import backproject, se3
from gsfusion_nb.types import Camera, Frame
from gsfusion_nb.viz import point_panel, repair_panel
from gsfusion_nb.viz.panels.frames import displaced_pose, pixel_story, point_view

CAMERA = Camera(
    width=64,
    height=48,
    fx=50.0,
    fy=50.0,
    cx=32.0,
    cy=24.0,
)


@pytest.fixture
def frame():
    """A grey wall at 2 m with a red square at 1 m in the middle; no depth in the lowest row; some
    pose."""
    rgb = torch.full((48, 64, 3), 0.5)
    depth_m = torch.full((48, 64), 2.0)
    rgb[20:28, 28:36] = torch.tensor([1.0, 0.0, 0.0])
    depth_m[20:28, 28:36] = 1.0
    depth_m[-1] = 0
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.4, -0.7, 0.2]))
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=CAMERA,
        T_WC=T_WC,
    )


def red(picture):
    return np.argwhere((picture[..., 0] > 200) & (picture[..., 1] < 50))


def test_the_same_pose_gives_the_picture_back(frame):
    picture = point_view(frame, frame.T_WC)
    expected = (frame.rgb.numpy() * 255 + 0.5).astype(np.uint8)
    assert (picture[:-1] == expected[:-1]).all()
    assert (picture[-1] == 0).all()  # no depth, no point


def test_a_step_to_the_right_moves_near_things_farther_to_the_left(frame):
    step_m = 0.1
    picture = point_view(frame, displaced_pose(frame.T_WC, step_m, 0.0))
    assert red(picture).mean(0) + 0.5 == pytest.approx([24, 32 - 50 * step_m / 1.0], abs=0.51)
    hole = np.argwhere((picture[:-1] == 0).all(-1))
    beside = hole[(hole[:, 0] >= 21) & (hole[:, 0] < 27) & (hole[:, 1] < 40)]
    assert len(beside) > 0  # where the wall was hidden
    assert beside[:, 1].min() > red(picture)[:, 1].max() - 1


def test_the_nearest_point_wins_and_points_can_be_larger(frame):
    closer = displaced_pose(frame.T_WC, 0.0, 0.0, 0.5)
    picture = point_view(frame, closer)
    assert len(red(picture)) <= 64  # as many points as before, now with gaps
    full = point_view(frame, closer, point_px=3)
    rows = red(full)[:, 0]
    assert rows.max() - rows.min() >= 14  # twice as large from half as far
    assert (full[22:26, 30:34] == (255, 0, 0)).all()


def test_a_click_on_the_frame_lifts_its_pixel(frame):
    panel = point_panel(frame)
    W = frame.camera.width
    H = frame.camera.height
    panel.drag((20.4, 26 + 30.7))
    assert (panel.values["u"], panel.values["v"]) == (20, 30)
    xyz = backproject(
        frame.camera,
        torch.tensor([[20.5, 30.5]]),
        frame.depth_m[30, 20].view(1),
    )[0]
    assert "pixel (20, 30)" in panel.caption.value
    assert ", ".join(f"{x:.3f}" for x in xyz.tolist()) in panel.caption.value
    panel.drag(
        (W + 6 + 10, 26 + 9),
        (W + 6 + 10 - frame.camera.fx * np.radians(8), 26 + 9),
    )
    # the picture follows the pointer: to the left, when the camera turns right
    assert panel.values["turn_deg"] == 8
    assert (
        pixel_story(
            frame,
            displaced_pose(frame.T_WC, 0.0, 170.0).float(),
            W // 2,
            H // 2,
        )[0]
        is None
    )
    place, words = pixel_story(frame, frame.T_WC, W // 2, H // 2)
    assert place == pytest.approx((W // 2 + 0.5, H // 2 + 0.5), abs=1e-3)
    assert "no depth" not in words


def agreeing(panel) -> int:
    return int(re.findall(r"<b>(\d+)%</b>", panel.caption.value)[0])


def test_the_true_repair_is_the_best(tmp_path):
    made = HandHeld(n_images=8, width=48, height=36, noise="none", images_per_walk=300)
    recording = tum(write_hand_held(tmp_path / "hand_held", made), camera=made.camera)
    panel = repair_panel(recording, 0, 2)
    as_read = agreeing(panel)
    panel.set(depth_factor=5.0, pose_shift=1.5)
    assert agreeing(panel) > max(70, as_read + 30)
    picture = panel.picture()
    panel.set(right_px=5.0, down_px=-3.0)
    assert (panel.picture() != picture).any()
    with pytest.raises(IndexError, match="second"):
        repair_panel(recording, 0, 99)
