"""Association, point-to-plane residual, its Jacobian and the normal equations, on the reference."""

import math

import pytest
import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import DepthLevel, Surface, associate, depth_pyramid, icp_system, point_to_plane
from gsfusion_nb.tracking.normal_equations import depth_weight
from gsfusion_nb.types import Camera

GATES = {"max_distance_m": 0.3, "min_cosine": 0.5}


def normals(generator, n):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=-1)


def test_one_point_by_hand():
    xyz, at = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[1.0, 2.0, 2.9]])
    r, J = point_to_plane(xyz, at, torch.tensor([[0.0, 0.0, -1.0]]))
    assert r.tolist() == pytest.approx([-0.1])
    assert J.tolist() == [[0.0, 0.0, -1.0, -2.0, 1.0, 0.0]]  # p x n = (2 * -1 - 0, 3 * 0 - 1 * -1, 0)


def test_jacobian_is_the_central_difference(generator):
    xyz, at = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    n = normals(generator, 50)
    J = point_to_plane(xyz, at, n)[1]
    step, numeric = 1e-6, torch.empty_like(J)
    for k in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[k] = step
        ahead, behind = (point_to_plane(se3.apply(se3.exp(s * xi), xyz), at, n)[0] for s in (1, -1))
        numeric[:, k] = (ahead - behind) / (2 * step)
    assert float((J - numeric).norm() / J.norm()) < 1e-8
    torch.testing.assert_close(J, numeric, rtol=1e-6, atol=1e-8)


def pair(plane_scene, even_to_m=None):
    """A frame of the corner in float64, away from where the surface was rendered."""
    scene, T_WC = plane_scene("corner"), se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.05, 0.1, -0.05]).double())
    frame = scene.frame(T_WC)
    surface = scene(frame.camera, T_WC)
    level = depth_pyramid(frame.depth_m, frame.camera, (2,))[0]
    level = DepthLevel(factor=2, camera=level.camera, depth_m=level.depth_m.double(), normal_C=level.normal_C.double())
    start = se3.exp(torch.tensor([0.01, -0.02, 0.015, 0.01, -0.01, 0.02]).double()) @ T_WC
    return level, start, surface


@pytest.mark.parametrize("even_to_m", [None, 1.5])
def test_gradient_is_the_central_difference_of_the_energy(plane_scene, even_to_m):
    level, T_WC, surface = pair(plane_scene)
    system = icp_system.reference(level, T_WC, surface, **GATES, even_to_m=even_to_m)
    centre = torch.eye(4, dtype=torch.float64)
    centre[:3, 3] = surface.T_WC[:3, 3]

    def half_energy(xi):
        moved = centre @ se3.exp(xi) @ se3.inverse(centre) @ T_WC
        found = associate(level, moved, surface, **GATES)
        fixed = associate(level, T_WC, surface, **GATES)
        rows = fixed.inlier
        r, _ = point_to_plane(found.xyz[rows], fixed.surface_xyz[rows], fixed.surface_normal[rows])
        return 0.5 * (depth_weight(level.depth_m[rows], even_to_m) * r * r).sum()

    numeric = torch.empty(6, dtype=torch.float64)
    for k in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[k] = 1e-5
        numeric[k] = (half_energy(xi) - half_energy(-xi)) / 2e-5
    torch.testing.assert_close(system.b, numeric, rtol=1e-6, atol=1e-6)
    assert system.sum_squares_m2 == pytest.approx(2 * float(half_energy(torch.zeros(6).double())), rel=1e-9)


def test_hessian_is_symmetric_positive_and_sums_the_rows(plane_scene):
    level, T_WC, surface = pair(plane_scene)
    system = icp_system.reference(level, T_WC, surface, **GATES)
    found = associate(level, T_WC, surface, **GATES)
    _, J = point_to_plane(*(getattr(found, n)[found.inlier] for n in ("xyz", "surface_xyz", "surface_normal")))
    torch.testing.assert_close(system.H, sum(torch.outer(row, row) for row in J), rtol=1e-10, atol=1e-9)
    assert torch.equal(system.H, system.H.T)
    assert float(torch.linalg.eigvalsh(system.H)[0]) > 0
    assert system.n_inliers == int(found.inlier.sum()) <= system.n_overlap == int(found.overlap.sum())
    assert system.sum_weights == system.n_inliers
    assert system.rms_m == pytest.approx(math.sqrt(system.sum_squares_m2 / system.n_inliers))


def test_the_surfaces_point_is_that_of_the_pixel_it_falls_on():
    """One pixel, moved by 0.6 of a pixel of the surface: by hand."""
    camera = Camera(width=4, height=4, fx=2.0, fy=2.0, cx=2.0, cy=2.0)
    depth, normal = torch.zeros(4, 4), torch.zeros(4, 4, 3)
    depth[1, 2], normal[1, 2] = 2.0, torch.tensor([0.0, 0.0, -1.0])
    level = DepthLevel(factor=1, camera=camera, depth_m=depth, normal_C=normal)
    target, target_normal = torch.zeros(4, 4), torch.zeros(4, 4, 3)
    target[1, 3], target_normal[1, 3] = 2.1, torch.tensor([0.0, 0.0, -1.0])
    T_WS = torch.eye(4)
    T_WS[0, 3] = 10.0
    surface = Surface(depth_m=target, normal_W=target_normal, camera=camera, T_WC=T_WS)
    T_WC = T_WS.clone()
    T_WC[0, 3] += 0.6
    # the point (0.5, -0.5, 2) moves to x = 1.1: u = 2 * 1.1 / 2 + 2 = 3.1, v = 1.5
    found = associate(level, T_WC, surface, max_distance_m=0.5, min_cosine=0.9)
    assert found.overlap.nonzero().tolist() == [[1, 2]]
    assert found.xyz[1, 2].tolist() == pytest.approx([1.1, -0.5, 2.0], abs=1e-6)
    assert found.surface_xyz[1, 2].tolist() == pytest.approx([1.575, -0.525, 2.1], abs=1e-6)
    assert bool(found.inlier[1, 2])
    assert not associate(level, T_WC, surface, max_distance_m=0.4, min_cosine=0.9).inlier.any()


def test_weights_fall_with_the_fourth_power_of_depth():
    z = torch.tensor([0.5, 1.0, 2.0, 4.0])
    torch.testing.assert_close(depth_weight(z, 1.0), torch.tensor([1.0, 1.0, 1 / 16, 1 / 256]))
    assert depth_weight(z, None).tolist() == [1.0] * 4


def test_nothing_to_match(plane_scene):
    level, T_WC, surface = pair(plane_scene)
    away = T_WC.clone()
    away[:3, 3] += 50.0
    system = icp_system.reference(level, away, surface, **GATES)
    assert (system.n_inliers, system.rms_m) == (0, math.inf)
    assert not system.H.any()
