"""Frame-to-model ICP on scenes whose pose is known exactly."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import (
    DepthLevel,
    IcpSystem,
    Surface,
    align,
    associate,
    depth_pyramid,
    icp,
    icp_system,
    point_to_plane,
)
from gsfusion_nb.tracking.icp import Extent, depth_weight, solve_step
from gsfusion_nb.types import Camera

EXACT = TrackingConfig(even_to_m=None, pyramid=(4, 2, 1), iterations=(10, 10, 10))


def perturbation(generator, metres, degrees):
    direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator).double(), dim=-1)
    return se3.exp(torch.cat([metres * direction[0], torch.tensor(degrees).deg2rad() * direction[1]]))


@pytest.fixture(scope="module")
def views():
    """Frames of the built-in room, each with its own depth as the surface."""
    sequence, found = room(width=160, height=120), []
    for i in (0, 30, 60, 150):
        frame = sequence[i]
        normal_W = se3.rotate(frame.T_WC, depth_to_normals(frame.camera, frame.depth_m))
        found.append((frame, Surface(depth_m=frame.depth_m, normal_W=normal_W, camera=frame.camera, T_WC=frame.T_WC)))
    return found


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_a_corner_is_found_from_5_cm_and_5_degrees_away(plane_scene, generator, assert_pose, backend):
    scene = plane_scene("corner")
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.05, 0.1, -0.05]).double())
    frame, surface = scene.frame(T_WC), scene(scene.frame(T_WC).camera, T_WC)
    for _ in range(4):
        with use_backend(backend):
            found = icp(frame.depth_m, frame.camera, surface, perturbation(generator, 0.05, 5.0) @ T_WC, EXACT)
        assert_pose(found.T_WC, T_WC, 1e-4, 0.01)
        assert found.degenerate == 0
        assert found.rms_m < 1e-4
        assert found.inlier_share > 0.95


def test_the_room_is_found_from_5_cm_and_5_degrees_away(views, generator, assert_pose):
    for frame, surface in views:
        for config in (EXACT, dataclasses.replace(EXACT, even_to_m=1.0)):
            for _ in range(3):
                start = frame.T_WC.double() @ perturbation(generator, 0.05, 5.0)
                found = icp(frame.depth_m, frame.camera, surface, start, config)
                assert_pose(found.T_WC, frame.T_WC, 5e-4, 0.03)


def test_another_place_in_the_world_changes_nothing(plane_scene, generator, assert_pose):
    scene = plane_scene("corner")
    T_WC = torch.eye(4).double()
    frame, surface = scene.frame(T_WC), scene(scene.frame(T_WC).camera, T_WC)
    start = perturbation(generator, 0.03, 3.0)
    there = se3.exp(torch.tensor([200.0, -300.0, 50.0, 1.0, -2.0, 0.5]).double())
    far = dataclasses.replace(surface, T_WC=there, normal_W=se3.rotate(there.float(), surface.normal_W))
    near = icp(frame.depth_m, frame.camera, surface, start, EXACT)
    found = icp(frame.depth_m, frame.camera, far, there @ start, EXACT)
    assert_pose(se3.inverse(there) @ found.T_WC, near.T_WC, 1e-4, 0.005)
    assert found.eigenvalues == pytest.approx(near.eigenvalues, rel=0.02)


def test_further_rows_decide_what_depth_leaves_open(plane_scene):
    """A wall seen from far from the world's origin; two points of known place give the motion along it and the roll."""
    away = se3.exp(torch.tensor([40.0, -30.0, 20.0, 0.3, -1.2, 0.4]).double())
    planes, T_WC = plane_scene("wall"), torch.eye(4).double()
    frame, seen = planes.frame(T_WC), planes(planes.frame(T_WC).camera, T_WC)
    surface = dataclasses.replace(seen, normal_W=se3.rotate(away.float(), seen.normal_W), T_WC=away)
    known_C = torch.tensor([[0.5, 0.3, 2.0], [-0.6, 0.1, 2.0]]).double()

    def points(T):
        J, r = [], (se3.apply(T, known_C) - se3.apply(away, known_C)).reshape(-1)
        for p in se3.apply(T, known_C):
            J.append(torch.cat([torch.eye(3).double(), -se3.hat(p)], dim=1))
        J = torch.cat(J)
        return 1000 * J.T @ J, 1000 * J.T @ r

    start = away @ se3.exp(torch.tensor([0.02, 0.03, -0.04, 0.01, 0.01, 0.05]).double())
    levels = depth_pyramid(frame.depth_m, frame.camera, EXACT.pyramid)
    alone, joined = (align(levels, surface, start, EXACT, rows) for rows in (None, points))
    assert (alone.degenerate, joined.degenerate) == (3, 0)
    torch.testing.assert_close(joined.T_WC, away, atol=1e-4, rtol=0)
    assert float((alone.T_WC - away)[:3, 3].norm()) > 0.02


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
