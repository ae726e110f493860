"""Poses between given ones: two, a list with times, and a smooth path."""

import math

import pytest
import torch

from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.geometry.pose_path import PosePath, pose_at, pose_between


@pytest.fixture
def poses(generator):
    """Ten poses, turned by up to a radian and a half and moved by metres."""
    xi = torch.randn(10, 6, generator=generator, dtype=torch.float64)
    return se3.exp(xi)


@pytest.fixture
def quarter_turn():
    """The identity, and a quarter turn about z at (2, 4, 6)."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    half = math.sqrt(0.5)
    poses[1, :3, :3] = quaternion.to_matrix(
        torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64)
    )
    poses[1, :3, 3] = torch.tensor([2.0, 4.0, 6.0])
    return poses


def test_halfway_is_as_far_from_both_poses(poses):
    halfway = pose_between(poses[0], poses[1], 0.5)
    assert torch.allclose(
        halfway[:3, 3],
        (poses[0] + poses[1])[:3, 3] / 2,
    )
    angles = [se3.rotation_angle(poses[i, :3, :3].T @ halfway[:3, :3]) for i in (0, 1)]
    assert torch.allclose(angles[0], angles[1])


def test_each_row_has_its_own_share_and_the_start_is_exact(poses):
    share = torch.linspace(0, 1, 9, dtype=torch.float64)
    T = pose_between(poses[:9], poses[1:], share)
    for i in range(9):
        torch.testing.assert_close(T[i], pose_between(poses[i], poses[i + 1], float(share[i])))
    assert torch.equal(T[0], poses[0])
    torch.testing.assert_close(T[-1], poses[-1])
    assert torch.equal(pose_between(poses, poses, 0.3), poses)


def test_the_pivot_moves_along_a_straight_line(poses):
    pivot = torch.tensor([0.3, -2.0, 1.5], dtype=torch.float64)
    ends = [se3.apply(T, pivot) for T in (poses[0], poses[1])]
    T = pose_between(poses[0], poses[1], 0.25, pivot=pivot)
    torch.testing.assert_close(se3.apply(T, pivot), 0.75 * ends[0] + 0.25 * ends[1])
    plain = pose_between(poses[0], poses[1], 0.25)
    torch.testing.assert_close(T[:3, :3], plain[:3, :3])


def test_a_pose_at_a_time_by_hand(quarter_turn):
    times_s = torch.tensor([10.0, 10.1], dtype=torch.float64)
    T = pose_at(times_s, quarter_turn, 10.05, max_gap_s=0.2)
    assert T is not None
    quat = quaternion.from_matrix(T[:3, :3])
    eighth = math.pi / 8
    assert quat.tolist() == pytest.approx([math.cos(eighth), 0, 0, math.sin(eighth)])
    assert T[:3, 3].tolist() == pytest.approx([1, 2, 3])
    for time_s, expected in ((10.0, quarter_turn[0]), (10.1, quarter_turn[1])):
        exact = pose_at(times_s, quarter_turn, time_s, max_gap_s=0.2)
        assert exact is not None
        assert torch.equal(exact, expected)
    assert pose_at(times_s, quarter_turn, 9.99, max_gap_s=0.2) is None
    assert pose_at(times_s, quarter_turn, 10.11, max_gap_s=0.2) is None
    assert pose_at(times_s, quarter_turn, 10.05, max_gap_s=0.05) is None


def test_a_path_goes_through_its_poses_and_is_exact_for_even_motion():
    times_s = torch.tensor([0.0, 0.1, 0.2, 0.35, 0.4, 5.0], dtype=torch.float64)
    velocity = torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.9], dtype=torch.float64)
    poses = se3.exp(times_s[:, None] * velocity)
    poses[2] = torch.nan
    path = PosePath(times_s, poses)
    between = torch.tensor([-0.05, 0.03, 0.1, 0.18, 0.38], dtype=torch.float64)
    torch.testing.assert_close(path.at(between), se3.exp(between[:, None] * velocity))
    # nothing near says how it moves there
    torch.testing.assert_close(path.at(times_s[-1:] + 0.05), poses[-1:])
    assert bool(path.at(torch.tensor([1.0], dtype=torch.float64)).isnan().all())
