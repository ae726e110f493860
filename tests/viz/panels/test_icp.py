"""ICP step by step, the map of its basin, and paths from above."""

import dataclasses

import numpy as np
import pytest
import torch

from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.data.room.sequence import RoomSequence
from gsfusion_nb.viz.panels.icp import (
    basin_picture,
    convergence_basin,
    displaced_pose,
    frame_surface,
    icp_panel,
    overlay_picture,
    pose_error,
    residual_picture,
    single_level_config,
)


@pytest.fixture(scope="module")
def pair():
    """Two views of the room, a little apart."""
    room = RoomSequence(n_frames=480, width=80, height=60)
    return room[40], room[42]


def test_a_start_is_off_by_what_was_asked(pair):
    frame = pair[1]
    start = displaced_pose(frame.T_WC, 0.1, 0)
    assert pose_error(start, frame.T_WC) == pytest.approx((0.1, 0.0), abs=1e-4)
    right = start[:3, 3] - frame.T_WC[:3, 3].double()
    assert torch.allclose(
        right / right.norm(),
        frame.T_WC[:3, 0].double(),
        atol=1e-4,
    )
    assert pose_error(displaced_pose(frame.T_WC, 0, 5), frame.T_WC) == pytest.approx(
        (0.0, 5.0), abs=1e-3
    )


def test_a_point_behind_the_surface_is_red_and_one_before_it_blue(pair):
    wall = dataclasses.replace(
        pair[0],
        depth_m=torch.full((60, 80), 2.0),
        T_WC=torch.eye(4),
    )
    surface = frame_surface(wall)
    for z, reddish in ((0.02, True), (-0.02, False)):
        T = torch.eye(4).double()
        T[2, 3] = z
        picture = residual_picture(wall, surface, T, TrackingConfig())
        red = picture[15, 20, 0]
        blue = picture[15, 20, 2]
        assert (red > blue) == reddish


def test_a_longer_residual_has_a_stronger_colour_up_to_the_gate(pair):
    wall = dataclasses.replace(
        pair[0],
        depth_m=torch.full((60, 80), 2.0),
        T_WC=torch.eye(4),
    )
    surface = frame_surface(wall)
    config = TrackingConfig(max_distance_m=0.2)
    greens = []
    for z in (0.0, 0.002, 0.03, 0.08, 0.19):
        T = torch.eye(4).double()
        T[2, 3] = -z
        greens.append(int(residual_picture(wall, surface, T, config)[15, 20, 1]))
    steps = -np.diff(greens)
    assert (steps > 8).all()


def test_the_overlay_of_a_frame_on_itself_is_the_frame(pair):
    known = pair[0]
    picture = overlay_picture(known, frame_surface(known), known.T_WC.double())
    assert np.abs(picture.astype(int) - (known.rgb.numpy() * 255)).mean() < 4


def test_the_panel_converges_from_near_and_not_from_afar(pair):
    known, frame = pair
    panel = icp_panel(frame, frame_surface(known))
    panel.set(sideways_cm=3, turn_deg=1, step=15)
    assert "<b>converged" in panel.caption.value
    assert "after all" in panel.caption.value
    panel.set(sideways_cm=60, turn_deg=20)
    assert "not converged" in panel.caption.value
    # nothing corresponds: there is no step to take
    assert "after all 0 steps" in panel.caption.value
    panel.set(step=0, pyramid=False, sideways_cm=3, turn_deg=1)
    assert "2 × 2 px" in panel.caption.value


def test_the_basin_holds_the_truth_and_coarse_levels_widen_it(pair):
    known, frame = pair
    surface = frame_surface(known)
    config = TrackingConfig()
    sideways = [-0.2, 0.0, 0.2]
    turns = [-8.0, 0.0, 8.0]
    wide = convergence_basin(frame, surface, sideways, turns)
    narrow = convergence_basin(frame, surface, sideways, turns, single_level_config(config))
    assert wide.shape == (3, 3)
    assert wide[1, 1] < 0.02
    assert (narrow < 0.02).sum() <= (wide < 0.02).sum() < 9
    picture = basin_picture(wide, sideways, turns)
    assert (picture == (61, 133, 198)).all(-1).sum() > 500 * (wide < 0.02).sum()
