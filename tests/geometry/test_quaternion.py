import math

import pytest
import torch

from gsfusion_nb.geometry import quaternion, se3

BATCHES = [(), (1,), (3, 1, 2)]
ANGLES = [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-7, math.pi]


def unit(generator, batch):
    return quaternion.normalise(torch.randn(*batch, 4, generator=generator, dtype=torch.float64))


def about(axis, angle):
    half = torch.tensor(angle / 2, dtype=torch.float64)
    return torch.cat([half.cos().expand(*axis.shape[:-1], 1), axis * half.sin()], dim=-1)


def test_by_hand():
    torch.testing.assert_close(quaternion.to_matrix(torch.tensor([1.0, 0, 0, 0])), torch.eye(3))
    half = math.sqrt(0.5)
    R = quaternion.to_matrix(torch.tensor([half, 0, 0, half]))  # a quarter turn about z: x goes to y
    torch.testing.assert_close(R @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    torch.testing.assert_close(quaternion.to_matrix(torch.tensor([3 * half, 0, 0, 3 * half])), R)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_round_trip_and_agreement_with_exp(generator, batch, angle):
    axis = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
    R = quaternion.to_matrix(about(axis, angle))
    assert R.shape == (*batch, 3, 3)
    twist = torch.cat([torch.zeros_like(axis), axis * angle], dim=-1)
    torch.testing.assert_close(R, se3.exp(twist)[..., :3, :3], atol=1e-10, rtol=0)
    back = quaternion.from_matrix(R)
    assert (back[..., 0] >= 0).all()
    torch.testing.assert_close(quaternion.to_matrix(back), R, atol=1e-12, rtol=0)


def test_round_trip_of_each_of_the_four_formulas():
    for k in range(4):
        quat = torch.full((4,), 0.1, dtype=torch.float64)
        quat[k] = 1.0
        quat = quaternion.normalise(quat)
        torch.testing.assert_close(quaternion.from_matrix(quaternion.to_matrix(quat)), quat)


def test_matrix_is_a_rotation(generator):
    R = quaternion.to_matrix(unit(generator, (50,)))
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(50, dtype=torch.float64))


def test_slerp(generator):
    a, b = unit(generator, (20,)), unit(generator, (20,))
    ends = quaternion.to_matrix(a), quaternion.to_matrix(b)
    zero, one = torch.zeros(20, dtype=torch.float64), torch.ones(20, dtype=torch.float64)
    torch.testing.assert_close(quaternion.to_matrix(quaternion.slerp(a, b, zero)), ends[0])
    torch.testing.assert_close(quaternion.to_matrix(quaternion.slerp(a, b, one)), ends[1])
    middle = quaternion.to_matrix(quaternion.slerp(a, -b, one / 4))  # -b is the same orientation
    whole = se3.rotation_angle(ends[0].transpose(1, 2) @ ends[1])
    torch.testing.assert_close(se3.rotation_angle(ends[0].transpose(1, 2) @ middle), whole / 4)
    torch.testing.assert_close(quaternion.slerp(a, a, one / 2), a)
