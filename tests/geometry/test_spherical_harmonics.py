import math

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry.spherical_harmonics import (
    rgb_to_sh_dc,
    sh_basis,
    sh_basis_gradient,
    sh_to_rgb,
    sh_to_rgb_vjp,
)

ORIGIN = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)


def some(generator, n, degree):
    sh = 0.4 * torch.randn(
        n,
        (degree + 1) ** 2,
        3,
        generator=generator,
        dtype=torch.float64,
    )
    xyz = torch.randn(n, 3, generator=generator, dtype=torch.float64) + 2
    return sh, xyz


def test_colours_of_the_released_code():
    dc = rgb_to_sh_dc(torch.tensor([[0.0, 128 / 255, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(
        dc,
        dc.new_tensor([[-1.772454, 0.0069508, 1.772454]]),
        atol=1e-6,
        rtol=0,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_constant_coefficient_gives_the_same_colour_from_everywhere(generator, degree):
    sh, xyz = some(generator, 7, degree)
    rgb = torch.rand(7, 3, generator=generator, dtype=torch.float64)
    sh[:, 0] = rgb_to_sh_dc(rgb)
    sh[:, 1:] = 0
    torch.testing.assert_close(sh_to_rgb(sh, xyz, ORIGIN), rgb)


def test_first_degree_by_hand():
    s = math.sqrt(3 / (4 * math.pi))
    basis = sh_basis(torch.eye(3, dtype=torch.float64), 1)
    expected = [[0, 0, -s], [-s, 0, 0], [0, s, 0]]  # order -y, z, -x
    torch.testing.assert_close(basis[:, 1:], basis.new_tensor(expected))


def test_basis_is_orthonormal_on_the_sphere():
    # Gauss-Legendre in z and a uniform grid in longitude integrate polynomials of degree 6 exactly
    z, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()[:, None]
    dirs = torch.stack(
        [r * phi.cos(), r * phi.sin(), z[:, None].expand(-1, 16)],
        -1,
    ).reshape(-1, 3)
    Y = sh_basis(dirs, 3)
    gram = (Y * (weight * 2 * math.pi / 16).repeat_interleave(16)[:, None]).T @ Y
    torch.testing.assert_close(
        gram,
        torch.eye(16, dtype=torch.float64),
        atol=1e-12,
        rtol=0,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_vjp_is_the_autograd_of_the_forward(generator, degree):
    sh, xyz = some(generator, 40, degree)
    v = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    leaves = [sh.clone().requires_grad_(), xyz.clone().requires_grad_()]
    rgb = sh_to_rgb(leaves[0], leaves[1], ORIGIN)
    assert degree == 0 or (rgb == 0).any(), "the clamp should be met in this test"
    expected = torch.autograd.grad(rgb, leaves, v, allow_unused=True, materialize_grads=True)
    torch.testing.assert_close(sh_to_rgb_vjp(sh, xyz, ORIGIN, v), expected)


def test_vjp_by_finite_differences(generator):
    sh, xyz = some(generator, 5, 3)
    dirs = torch.nn.functional.normalize(xyz, dim=-1)
    step = 1e-6
    for axis in range(3):
        e = torch.zeros(3, dtype=torch.float64)
        e[axis] = step
        slope = (sh_basis(dirs + e, 3) - sh_basis(dirs - e, 3)) / (2 * step)
        torch.testing.assert_close(
            sh_basis_gradient(dirs, 3)[:, :, axis], slope, atol=1e-7, rtol=1e-7
        )
    assert (
        sh_to_rgb(
            sh.float(),
            xyz.float(),
            ORIGIN.float(),
        ).dtype
        == torch.float32
    )


def test_no_gaussians_and_wrong_sizes():
    empty = torch.zeros(0, 16, 3)
    assert sh_to_rgb(empty, torch.zeros(0, 3), torch.zeros(3)).shape == (0, 3)
    with pytest.raises(ValueError, match="K = 1, 4, 9 or 16"):
        sh_to_rgb(
            torch.zeros(2, 5, 3),
            torch.ones(2, 3),
            torch.zeros(3),
        )
    with pytest.raises(ValueError, match="must be 0, 1, 2 or 3"):
        sh_basis(torch.zeros(1, 3), 4)
