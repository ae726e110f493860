"""Which candidate loops are true."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data.room import render_room, room
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.features import extract_features
from gsfusion_nb.tracking.loop_finder import (
    depth_agreement,
    depth_thumbnail,
    may_drift,
    why_not_same_place,
)
from gsfusion_nb.tracking.matching import relative_pose


def turned(degrees):
    xi = torch.zeros(6, dtype=torch.float64)
    xi[4] = torch.deg2rad(torch.tensor(degrees))
    return se3.exp(xi)


def shifted(x):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


@pytest.fixture(scope="module")
def pair():
    """Two views of the room and the true pose of the first relative to the second."""
    sequence = room(n_frames=400, width=320, height=240)
    a = sequence[40]
    b = sequence[46]
    return a, b, se3.inverse(b.T_WC.double()) @ a.T_WC.double()


def test_depths_agree_at_the_true_pose_only(pair):
    a, b, T_BA = pair
    thumbnails = depth_thumbnail(a.depth_m), depth_thumbnail(b.depth_m)
    share, pixels = depth_agreement(a.camera, *thumbnails, T_BA)
    assert share > 0.9
    assert pixels > 1000
    wrong, _ = depth_agreement(a.camera, *thumbnails, T_BA @ turned(40.0))
    assert wrong < 0.7


def test_a_true_loop_passes_and_others_say_why(pair):
    a, b, _ = pair
    query, reference = (extract_features(f, count=1000, levels=8) for f in (a, b))
    pose = relative_pose(a.camera, query, reference)
    assert pose is not None
    thumbnails = depth_thumbnail(a.depth_m), depth_thumbnail(b.depth_m)
    assert why_not_same_place(pose, query, thumbnails, a.camera) == ""
    few = dataclasses.replace(pose, n_matches=10 * len(pose.rows))
    assert "matches agree" in why_not_same_place(few, query, thumbnails, a.camera)
    corner = query.uv[pose.rows[:, 0]].sum(1).argsort()[:30]
    assert "parts of the image" in why_not_same_place(
        dataclasses.replace(pose, rows=pose.rows[corner][:1].repeat(40, 1), n_matches=40),
        query,
        thumbnails,
        a.camera,
    )
    _, depth_m = render_room(a.camera, b.T_WC @ turned(80.0).float())
    assert "depths agree" in why_not_same_place(
        pose, query, (thumbnails[0], depth_thumbnail(depth_m)), a.camera
    )


def test_the_path_bounds_the_drift():
    """After 10 m and 100 degrees: 2.3 m and 30 degrees; after none: 0.3 m."""
    path = torch.stack([shifted(0.0), shifted(10.0) @ turned(100.0)])
    assert may_drift(shifted(2.2), path)
    assert not may_drift(shifted(2.4), path)
    assert may_drift(turned(29.0), path)
    assert not may_drift(turned(31.0), path)
    assert may_drift(shifted(0.2), path[:1])
    assert not may_drift(shifted(0.4), path[:1])
