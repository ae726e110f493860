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
    return torch.cat(
        [half.cos().expand(*axis.shape[:-1], 1), axis * half.sin()],
        dim=-1,
    )


def test_by_hand():
    torch.testing.assert_close(
        quaternion.to_matrix(torch.tensor([1.0, 0, 0, 0])),
        torch.eye(3),
    )
    half = math.sqrt(0.5)
    # a quarter turn about z: x goes to y
    R = quaternion.to_matrix(torch.tensor([half, 0, 0, half]))
    torch.testing.assert_close(
        R @ torch.tensor([1.0, 0, 0]),
        torch.tensor([0.0, 1, 0]),
    )
    torch.testing.assert_close(
        quaternion.to_matrix(torch.tensor([3 * half, 0, 0, 3 * half])),
        R,
    )


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_round_trip_and_agreement_with_exp(generator, batch, angle):
    axis = torch.nn.functional.normalize(
        torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    R = quaternion.to_matrix(about(axis, angle))
    assert R.shape == (*batch, 3, 3)
    twist = torch.cat([torch.zeros_like(axis), axis * angle], dim=-1)
    torch.testing.assert_close(
        R,
        se3.exp(twist)[..., :3, :3],
        atol=1e-10,
        rtol=0,
    )
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
    torch.testing.assert_close(
        R @ R.transpose(1, 2),
        torch.eye(3, dtype=torch.float64).expand_as(R),
    )
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(50, dtype=torch.float64))


def test_slerp(generator):
    a = unit(generator, (20,))
    b = unit(generator, (20,))
    ends = quaternion.to_matrix(a), quaternion.to_matrix(b)
    zero = torch.zeros(20, dtype=torch.float64)
    one = torch.ones(20, dtype=torch.float64)
    torch.testing.assert_close(quaternion.to_matrix(quaternion.slerp(a, b, zero)), ends[0])
    torch.testing.assert_close(quaternion.to_matrix(quaternion.slerp(a, b, one)), ends[1])
    middle = quaternion.to_matrix(quaternion.slerp(a, -b, one / 4))  # -b is the same orientation
    whole = se3.rotation_angle(ends[0].transpose(1, 2) @ ends[1])
    torch.testing.assert_close(
        se3.rotation_angle(ends[0].transpose(1, 2) @ middle),
        whole / 4,
    )
    torch.testing.assert_close(quaternion.slerp(a, a, one / 2), a)


def test_multiply_by_hand():
    """i j = k, j i = -k."""
    i, j, k = torch.eye(4)[1:]
    torch.testing.assert_close(quaternion.multiply(i, j), k)
    torch.testing.assert_close(quaternion.multiply(j, i), -k)
    torch.testing.assert_close(
        quaternion.multiply(k, k),
        torch.tensor([-1.0, 0, 0, 0]),
    )


@pytest.mark.parametrize("batch", BATCHES)
def test_product_of_quaternions_is_the_product_of_matrices(generator, batch):
    a = unit(generator, batch)
    b = unit(generator, batch)
    product = quaternion.multiply(a, b)
    torch.testing.assert_close(
        quaternion.to_matrix(product),
        quaternion.to_matrix(a) @ quaternion.to_matrix(b),
        atol=1e-12,
        rtol=0,
    )
    torch.testing.assert_close(
        product.norm(dim=-1),
        torch.ones(batch, dtype=torch.float64),
    )


def directions(generator, batch):
    return torch.nn.functional.normalize(
        torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1
    )


@pytest.mark.parametrize("batch", [*BATCHES, (200,)])
def test_shortest_arc_turns_a_to_b_by_the_angle_between_them(generator, batch):
    a = directions(generator, batch)
    b = directions(generator, batch)
    q = quaternion.shortest_arc(a, b)
    R = quaternion.to_matrix(q)
    torch.testing.assert_close(
        (R @ a[..., None]).squeeze(-1),
        b,
        atol=1e-9,
        rtol=0,
    )
    angle = torch.atan2(
        torch.linalg.cross(a, b).norm(dim=-1),
        (a * b).sum(-1),
    )
    torch.testing.assert_close(se3.rotation_angle(R), angle, atol=1e-9, rtol=0)


def test_shortest_arc_of_equal_and_opposite_directions(generator):
    a = torch.cat(
        [
            directions(generator, (50,)),
            torch.eye(3, dtype=torch.float64),
            -torch.eye(3, dtype=torch.float64),
        ]
    )
    same = quaternion.shortest_arc(a, a)
    torch.testing.assert_close(
        same,
        torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(same),
    )
    R = quaternion.to_matrix(quaternion.shortest_arc(a, -a))
    torch.testing.assert_close(
        (R @ a[..., None]).squeeze(-1),
        -a,
        atol=1e-12,
        rtol=0,
    )
    torch.testing.assert_close(
        se3.rotation_angle(R),
        torch.full((56,), math.pi, dtype=torch.float64),
    )


@pytest.mark.parametrize("gap", [1e-7, 1e-4, 1e-3, 1.5e-3, 3e-3, 0.1])
def test_shortest_arc_close_to_opposite_in_float32(gap):
    z = torch.tensor([0.0, 0.0, 1.0])
    b = torch.tensor([math.sin(gap), 0.0, -math.cos(gap)])
    turned = quaternion.to_matrix(quaternion.shortest_arc(z, b)) @ z
    assert (turned - b).norm() < 2e-3  # within 1.4e-3 rad of opposite it takes the opposite
