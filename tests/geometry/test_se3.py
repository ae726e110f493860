import math

import pytest
import torch

from gsfusion_nb.geometry import se3

BATCHES = [(), (1,), (3, 1, 2)]
ANGLES = [0.0, 1e-9, 1e-4, 9e-3, 1.1e-2, 1.0, math.pi - 1e-6, math.pi]


def twist(generator, batch, angle):
    rho = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(
        torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    return torch.cat([rho, axis * angle], dim=-1)


def generator_matrix(xi):
    top = torch.cat(
        [se3.hat(xi[..., 3:]), xi[..., :3, None]],
        dim=-1,
    )
    return torch.cat(
        [top, torch.zeros_like(top[..., :1, :])],
        dim=-2,
    )


def test_identity():
    torch.testing.assert_close(se3.exp(torch.zeros(6)), torch.eye(4))
    torch.testing.assert_close(se3.inverse(torch.eye(4)), torch.eye(4))


def test_a_rounded_transform_is_made_rigid(generator):
    T = se3.exp(twist(generator, (5,), 1.0))
    off = T.clone()
    off[..., :3, :3] += 1e-3 * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    R = se3.rigid(off)[..., :3, :3]
    torch.testing.assert_close(
        R @ R.mT,
        torch.eye(3, dtype=torch.float64).expand(5, 3, 3),
    )
    assert float((R - T[..., :3, :3]).abs().max()) < 5e-3
    torch.testing.assert_close(se3.rigid(T), T)


def test_quarter_turn_by_hand():
    T = se3.exp(torch.tensor([0.0, 0, 0, 0, 0, math.pi / 2]))
    torch.testing.assert_close(
        se3.apply(T, torch.tensor([[1.0, 2, 3]])),
        torch.tensor([[-2.0, 1, 3]]),
    )
    T[:3, 3] = 5.0
    torch.testing.assert_close(
        se3.apply(T, torch.tensor([[1.0, 2, 3]])),
        torch.tensor([[3.0, 6, 8]]),
    )
    torch.testing.assert_close(
        se3.rotate(T, torch.tensor([[1.0, 2, 3]])),
        torch.tensor([[-2.0, 1, 3]]),
    )


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(generator, batch, angle):
    xi = twist(generator, batch, angle)
    T = se3.exp(xi)
    assert T.shape == (*batch, 4, 4)
    torch.testing.assert_close(
        T,
        torch.linalg.matrix_exp(generator_matrix(xi)),
        atol=1e-10,
        rtol=0,
    )
    eye = torch.eye(4, dtype=torch.float64).expand_as(T)
    torch.testing.assert_close(
        T @ se3.exp(-xi),
        eye,
        atol=1e-12,
        rtol=0,
    )
    torch.testing.assert_close(
        T @ se3.inverse(T),
        eye,
        atol=1e-12,
        rtol=0,
    )
    expected = torch.full(batch, angle, dtype=torch.float64)
    torch.testing.assert_close(
        se3.rotation_angle(T[..., :3, :3]),
        expected,
        atol=1e-9,
        rtol=0,
    )


@pytest.mark.parametrize("angle", [0.0, 1e-5, 9e-3, 1.1e-2, 2.0, 3.1])
def test_exp_has_finite_and_right_gradients(generator, angle):
    xi = twist(generator, (), angle).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, [xi], atol=1e-6)


def test_float32_keeps_its_digits_where_the_series_takes_over(generator):
    for angle in (5e-3, 9.9e-3, 1.01e-2, 2e-2):
        xi = twist(generator, (64,), angle)
        # worst seen 4e-6, at 1.01e-2 where 1 - cos t has lost three digits
        torch.testing.assert_close(
            se3.exp(xi.float()).double(),
            se3.exp(xi),
            atol=8e-6,
            rtol=0,
        )


def test_hat_is_the_cross_product(generator):
    a, b = torch.randn(2, 5, 3, generator=generator)
    torch.testing.assert_close(
        (se3.hat(a) @ b[..., None])[..., 0],
        torch.linalg.cross(a, b),
    )


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", [*ANGLES[:-1], 3e-2, 3.2e-2])
def test_log_undoes_exp(generator, batch, angle):
    xi = twist(generator, batch, angle)
    found = se3.log(se3.exp(xi))
    assert found.shape == xi.shape
    torch.testing.assert_close(found, xi, atol=1e-8, rtol=0)


def test_log_of_half_a_turn_is_one_of_the_two(generator):
    xi = twist(generator, (20,), math.pi)
    T = se3.exp(xi)
    found = se3.log(T)
    torch.testing.assert_close(se3.exp(found), T, atol=1e-7, rtol=0)
    torch.testing.assert_close(
        found[:, 3:].norm(dim=-1),
        xi[:, 3:].norm(dim=-1),
        atol=1e-7,
        rtol=0,
    )


def test_log_in_float32(generator):
    for angle in (0.0, 1e-4, 9e-3, 3e-2, 1.0, 3.0):
        xi = twist(generator, (64,), angle).float()
        torch.testing.assert_close(
            se3.log(se3.exp(xi)),
            xi,
            atol=2e-5,
            rtol=0,
        )


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-4, 3e-2, 3.3e-2, 2.0, 3.0])
def test_log_has_finite_and_right_gradients(generator, angle):
    xi = twist(generator, (), angle).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: se3.log(se3.exp(x)),
        [xi],
        atol=1e-6,
    )
