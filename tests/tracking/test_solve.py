import pytest
import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import IcpSystem, point_to_plane
from gsfusion_nb.tracking.solve import Extent, solve_step


def system_of(J, r):
    n = len(r)
    return IcpSystem(H=J.T @ J, b=J.T @ r, sum_squares_m2=float(r @ r), sum_weights=float(n), n_inliers=n, n_overlap=n)


def test_without_damping_it_is_least_squares(generator):
    J, r = torch.randn(40, 6, generator=generator).double(), torch.randn(40, generator=generator).double()
    extent = Extent(centre=torch.tensor([3.0, -2.0, 1.0]).double(), spread_m=0.7)
    step = solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=0.0)
    expected = torch.linalg.lstsq(J, -r[:, None]).solution[:, 0]
    torch.testing.assert_close(step.xi, expected, rtol=1e-8, atol=1e-10)
    assert step.degenerate == 0


def test_eigenvalues_do_not_depend_on_the_place_or_the_size_of_the_scene(generator):
    xyz = torch.randn(200, 3, generator=generator).double()
    n = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator).double(), dim=-1)
    found = []
    for scale, shift in ((1.0, 0.0), (5.0, 100.0)):
        p = scale * xyz + shift
        r, J = point_to_plane(p, p, n)
        extent = Extent(centre=p.mean(0), spread_m=float((p - p.mean(0)).square().sum(1).mean().sqrt()))
        found.append(solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=0.0).eigenvalues)
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-9)
    assert 1.0 < float(found[0].sum()) < 2.0


def test_a_wall_moves_only_along_its_normal_and_about_the_axes_in_it(generator):
    """n = -z: z translation and rotations about x and y are determined, through whatever point they are described."""
    xyz = torch.rand(300, 3, generator=generator).double() + torch.tensor([5.0, 1.0, 2.0]).double()
    xyz[:, 2] = 2.0
    n = torch.tensor([0.0, 0.0, -1.0]).double().expand(300, 3)
    moved = se3.apply(se3.exp(torch.tensor([0.3, -0.2, 0.01, 0.004, -0.003, 0.2]).double()), xyz)
    r, J = point_to_plane(moved, xyz, n)
    extent = Extent(centre=moved.mean(0), spread_m=0.4)
    step = solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=1e-3)
    assert step.degenerate == 3
    # the middle of the wall moves along the normal alone, which the exact minimum-norm solution does as well
    at_middle = step.xi[:3] + torch.linalg.cross(step.xi[3:], extent.centre)
    assert at_middle[:2].abs().max() < 1e-3
    assert float(step.xi[5].abs()) < 1e-3
    after = point_to_plane(se3.apply(se3.exp(step.xi), moved), xyz, n)[0]
    assert float(after.abs().max()) < 1e-4


def test_damping_shortens_the_step_and_nothing_gives_no_step(generator):
    J, r = torch.randn(40, 6, generator=generator).double(), torch.randn(40, generator=generator).double()
    extent = Extent(centre=torch.zeros(3).double(), spread_m=1.0)
    lengths = [solve_step(system_of(J, r), extent, damping=d, min_eigenvalue=0.0).length_m for d in (0.0, 0.1, 1.0)]
    assert lengths == sorted(lengths, reverse=True)
    nothing = solve_step(system_of(J[:0], r[:0]), extent, damping=1e-6, min_eigenvalue=1e-3)
    assert not nothing.xi.any()
    assert nothing.degenerate == 6
    assert nothing.length_m == pytest.approx(0.0)
