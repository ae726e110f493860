"""Frame-to-model ICP on scenes whose pose is known exactly."""

import dataclasses
import math

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
from gsfusion_nb.tracking.icp_step import Extent, solve_step
from gsfusion_nb.tracking.icp_system import depth_weight
from gsfusion_nb.types import Camera

EXACT = TrackingConfig(
    even_to_m=None,
    pyramid=(4, 2, 1),
    iterations=(10, 10, 10),
)


def perturbation(generator, metres, degrees):
    direction = torch.nn.functional.normalize(
        torch.randn(2, 3, generator=generator).double(), dim=-1
    )
    return se3.exp(
        torch.cat([metres * direction[0], torch.tensor(degrees).deg2rad() * direction[1]])
    )


@pytest.fixture(scope="module")
def views():
    """Frames of the built-in room, each with its own depth as the surface."""
    sequence = room(width=160, height=120)
    found = []
    for i in (0, 30, 60, 150):
        frame = sequence[i]
        normal_W = se3.rotate(frame.T_WC, depth_to_normals(frame.camera, frame.depth_m))
        found.append(
            (
                frame,
                Surface(
                    depth_m=frame.depth_m, normal_W=normal_W, camera=frame.camera, T_WC=frame.T_WC
                ),
            )
        )
    return found


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_a_corner_is_found_from_5_cm_and_5_degrees_away(
    plane_scene, generator, assert_pose, backend
):
    scene = plane_scene("corner")
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.05, 0.1, -0.05]).double())
    frame = scene.frame(T_WC)
    surface = scene(frame.camera, T_WC)
    for _ in range(4):
        with use_backend(backend):
            found = icp(
                frame.depth_m,
                frame.camera,
                surface,
                perturbation(generator, 0.05, 5.0) @ T_WC,
                EXACT,
            )
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
    frame = scene.frame(T_WC)
    surface = scene(frame.camera, T_WC)
    start = perturbation(generator, 0.03, 3.0)
    there = se3.exp(torch.tensor([200.0, -300.0, 50.0, 1.0, -2.0, 0.5]).double())
    far = dataclasses.replace(
        surface, T_WC=there, normal_W=se3.rotate(there.float(), surface.normal_W)
    )
    near = icp(frame.depth_m, frame.camera, surface, start, EXACT)
    found = icp(frame.depth_m, frame.camera, far, there @ start, EXACT)
    assert_pose(se3.inverse(there) @ found.T_WC, near.T_WC, 1e-4, 0.005)
    assert found.eigenvalues == pytest.approx(near.eigenvalues, rel=0.02)


def test_further_rows_decide_what_depth_leaves_open(plane_scene):
    """A wall seen from far from the world's origin; two points of known place give the motion along
    it and the roll."""
    away = se3.exp(torch.tensor([40.0, -30.0, 20.0, 0.3, -1.2, 0.4]).double())
    planes = plane_scene("wall")
    T_WC = torch.eye(4).double()
    frame = planes.frame(T_WC)
    seen = planes(frame.camera, T_WC)
    surface = dataclasses.replace(
        seen,
        normal_W=se3.rotate(away.float(), seen.normal_W),
        T_WC=away,
    )
    known_C = torch.tensor([[0.5, 0.3, 2.0], [-0.6, 0.1, 2.0]]).double()

    def points(T):
        J = []
        r = (se3.apply(T, known_C) - se3.apply(away, known_C)).reshape(-1)
        for p in se3.apply(T, known_C):
            J.append(
                torch.cat(
                    [torch.eye(3).double(), -se3.hat(p)],
                    dim=1,
                )
            )
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
    return torch.nn.functional.normalize(
        torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=-1
    )


def test_one_point_by_hand():
    xyz = torch.tensor([[1.0, 2.0, 3.0]])
    at = torch.tensor([[1.0, 2.0, 2.9]])
    r, J = point_to_plane(
        xyz,
        at,
        torch.tensor([[0.0, 0.0, -1.0]]),
    )
    assert r.tolist() == pytest.approx([-0.1])
    # p x n = (2 * -1 - 0, 3 * 0 - 1 * -1, 0)
    assert J.tolist() == [[0.0, 0.0, -1.0, -2.0, 1.0, 0.0]]


def test_jacobian_is_the_central_difference(generator):
    xyz, at = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    n = normals(generator, 50)
    J = point_to_plane(xyz, at, n)[1]
    step = 1e-6
    numeric = torch.empty_like(J)
    for k in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[k] = step
        ahead, behind = (point_to_plane(se3.apply(se3.exp(s * xi), xyz), at, n)[0] for s in (1, -1))
        numeric[:, k] = (ahead - behind) / (2 * step)
    assert float((J - numeric).norm() / J.norm()) < 1e-8
    torch.testing.assert_close(J, numeric, rtol=1e-6, atol=1e-8)


def pair(plane_scene, even_to_m=None):
    """A frame of the corner in float64, away from where the surface was rendered."""
    scene = plane_scene("corner")
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.05, 0.1, -0.05]).double())
    frame = scene.frame(T_WC)
    surface = scene(frame.camera, T_WC)
    level = depth_pyramid(frame.depth_m, frame.camera, (2,))[0]
    level = DepthLevel(
        factor=2,
        camera=level.camera,
        depth_m=level.depth_m.double(),
        normal_C=level.normal_C.double(),
    )
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
        r, _ = point_to_plane(
            found.xyz[rows],
            fixed.surface_xyz[rows],
            fixed.surface_normal[rows],
        )
        return 0.5 * (depth_weight(level.depth_m[rows], even_to_m) * r * r).sum()

    numeric = torch.empty(6, dtype=torch.float64)
    for k in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[k] = 1e-5
        numeric[k] = (half_energy(xi) - half_energy(-xi)) / 2e-5
    torch.testing.assert_close(system.b, numeric, rtol=1e-6, atol=1e-6)
    assert system.sum_squares_m2 == pytest.approx(
        2 * float(half_energy(torch.zeros(6).double())), rel=1e-9
    )


def test_the_surfaces_point_is_that_of_the_pixel_it_falls_on():
    """One pixel, moved by 0.6 of a pixel of the surface: by hand."""
    camera = Camera(
        width=4,
        height=4,
        fx=2.0,
        fy=2.0,
        cx=2.0,
        cy=2.0,
    )
    depth = torch.zeros(4, 4)
    normal = torch.zeros(4, 4, 3)
    depth[1, 2] = 2.0
    normal[1, 2] = torch.tensor([0.0, 0.0, -1.0])
    level = DepthLevel(factor=1, camera=camera, depth_m=depth, normal_C=normal)
    target = torch.zeros(4, 4)
    target_normal = torch.zeros(4, 4, 3)
    target[1, 3] = 2.1
    target_normal[1, 3] = torch.tensor([0.0, 0.0, -1.0])
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
    return IcpSystem(
        H=J.T @ J,
        b=J.T @ r,
        sum_squares_m2=float(r @ r),
        sum_weights=float(n),
        n_inliers=n,
        n_overlap=n,
    )


def test_without_damping_it_is_least_squares(generator):
    J = torch.randn(40, 6, generator=generator).double()
    r = torch.randn(40, generator=generator).double()
    extent = Extent(
        centre=torch.tensor([3.0, -2.0, 1.0]).double(),
        spread_m=0.7,
    )
    step = solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=0.0)
    expected = torch.linalg.lstsq(J, -r[:, None]).solution[:, 0]
    torch.testing.assert_close(step.xi, expected, rtol=1e-8, atol=1e-10)
    assert step.degenerate == 0


def test_a_wall_moves_only_along_its_normal_and_about_the_axes_in_it(generator):
    """n = -z: z translation and rotations about x and y are determined, through whatever point they
    are described."""
    xyz = torch.rand(300, 3, generator=generator).double() + torch.tensor([5.0, 1.0, 2.0]).double()
    xyz[:, 2] = 2.0
    n = torch.tensor([0.0, 0.0, -1.0]).double().expand(300, 3)
    moved = se3.apply(
        se3.exp(torch.tensor([0.3, -0.2, 0.01, 0.004, -0.003, 0.2]).double()),
        xyz,
    )
    r, J = point_to_plane(moved, xyz, n)
    extent = Extent(centre=moved.mean(0), spread_m=0.4)
    step = solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=1e-3)
    assert step.degenerate == 3
    # the middle of the wall moves along the normal alone, which the exact minimum-norm solution
    # does as well
    at_middle = step.xi[:3] + torch.linalg.cross(step.xi[3:], extent.centre)
    assert at_middle[:2].abs().max() < 1e-3
    assert float(step.xi[5].abs()) < 1e-3
    after = point_to_plane(
        se3.apply(se3.exp(step.xi), moved),
        xyz,
        n,
    )[0]
    assert float(after.abs().max()) < 1e-4


def test_damping_shortens_the_step_and_nothing_gives_no_step(generator):
    J = torch.randn(40, 6, generator=generator).double()
    r = torch.randn(40, generator=generator).double()
    extent = Extent(centre=torch.zeros(3).double(), spread_m=1.0)
    lengths = [
        solve_step(system_of(J, r), extent, damping=d, min_eigenvalue=0.0).length_m
        for d in (0.0, 0.1, 1.0)
    ]
    assert lengths == sorted(lengths, reverse=True)
    nothing = solve_step(
        system_of(J[:0], r[:0]),
        extent,
        damping=1e-6,
        min_eigenvalue=1e-3,
    )
    assert not nothing.xi.any()
    assert nothing.degenerate == 6
    assert nothing.length_m == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("scene", "open_directions"),
    [("wall", 3), ("edge", 1), ("corner", 0)],
)
def test_what_the_scene_does_not_show_is_left_to_the_start(
    plane_scene, assert_pose, scene, open_directions
):
    """A wall hides two translations and the rotation about its normal, an edge the translation
    along itself."""
    planes = plane_scene(scene)
    T_WC = torch.eye(4).double()
    frame = planes.frame(T_WC)
    start = se3.exp(torch.tensor([0.02, 0.03, -0.04, 0.01, 0.01, 0.0]).double())
    found = icp(
        frame.depth_m,
        frame.camera,
        planes(frame.camera, T_WC),
        start,
        EXACT,
    )
    assert found.degenerate == open_directions
    assert [e < 1e-3 * found.eigenvalues[-1] for e in found.eigenvalues] == [
        i < open_directions for i in range(6)
    ]
    assert found.rms_m < 1e-4
    middle = torch.tensor([[0.0, 0.0, 2.0]]).double()
    before = se3.apply(start, middle)[0]
    after = se3.apply(found.T_WC, middle)[0]
    turned = se3.log(found.T_WC)[3:]
    if scene == "corner":
        assert_pose(found.T_WC, T_WC, 1e-4, 0.01)
    # what is in the middle of the view stays where the start put it along the edge
    if scene == "edge":
        assert float(after[1]) == pytest.approx(float(before[1]), abs=1e-3)
        assert float(after[[0, 2]].sub(middle[0, [0, 2]]).abs().max()) < 1e-3
        assert float(turned.abs().max()) < 1e-3
    if scene == "wall":
        torch.testing.assert_close(
            after[:2],
            before[:2],
            atol=2e-3,
            rtol=0,
        )
        assert float(after[2]) == pytest.approx(2.0, abs=1e-4)
        assert float(turned.abs().max()) < 1e-3


def test_noise_of_the_normals_does_not_pass_for_information(plane_scene, generator):
    planes = plane_scene("wall")
    T_WC = torch.eye(4).double()
    frame = planes.frame(T_WC)
    surface = planes(frame.camera, T_WC)
    noisy = surface.normal_W + 0.02 * torch.randn(surface.normal_W.shape, generator=generator)
    surface = dataclasses.replace(surface, normal_W=torch.nn.functional.normalize(noisy, dim=-1))
    assert icp(frame.depth_m, frame.camera, surface, T_WC).degenerate == 3


def test_history_tells_every_step(plane_scene, generator):
    scene = plane_scene("corner")
    T_WC = torch.eye(4).double()
    frame = scene.frame(T_WC)
    start = perturbation(generator, 0.05, 3.0)
    found = icp(frame.depth_m, frame.camera, scene(frame.camera, T_WC), start)
    assert [step.factor for step in found.history] == sorted(
        (s.factor for s in found.history), reverse=True
    )
    assert {step.factor for step in found.history} == {8, 4, 2}
    torch.testing.assert_close(found.history[0].T_WC, start)
    assert found.history[0].rms_m > 20 * found.rms_m
    assert found.history[0].step_m > 0.01 > found.history[-1].step_m
    assert all(0 < step.n_inliers <= step.n_overlap for step in found.history)
    again = icp(frame.depth_m, frame.camera, scene(frame.camera, T_WC), T_WC)
    assert len(again.history) < len(found.history)  # ends as soon as the steps are small


def test_a_surface_of_another_size_and_pose(plane_scene, assert_pose):
    scene = plane_scene("corner")
    T_WC = se3.exp(torch.tensor([0.1, 0.05, 0.0, 0.02, 0.05, 0.0]).double())
    frame = scene.frame(T_WC)
    surface = scene(frame.camera.resized(101, 77), torch.eye(4).double())
    assert_pose(
        icp(frame.depth_m, frame.camera, surface, torch.eye(4), EXACT).T_WC,
        T_WC,
        1e-4,
        0.01,
    )


def test_nothing_to_align(plane_scene):
    scene = plane_scene("corner")
    frame = scene.frame(torch.eye(4))
    surface = scene(frame.camera, torch.eye(4))
    blank = dataclasses.replace(surface, depth_m=torch.zeros_like(surface.depth_m))
    start = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]).double())
    for depth_m, target in ((frame.depth_m, blank), (torch.zeros_like(frame.depth_m), surface)):
        found = icp(depth_m, frame.camera, target, start)
        assert (found.n_inliers, found.inlier_share, found.overlap_inlier_share, found.history) == (
            0,
            0.0,
            0.0,
            (),
        )
        assert torch.equal(found.T_WC, start)


@pytest.mark.parametrize("factors", [(7, 3), (5,), (16, 1)])
def test_levels_that_do_not_divide_the_size(plane_scene, generator, assert_pose, factors):
    scene = plane_scene("corner")
    T_WC = torch.eye(4).double()
    frame = scene.frame(T_WC)
    config = TrackingConfig(even_to_m=None, pyramid=factors, iterations=(12,) * len(factors))
    start = perturbation(generator, 0.03, 3.0)
    assert_pose(
        icp(frame.depth_m, frame.camera, scene(frame.camera, T_WC), start, config).T_WC,
        T_WC,
        2e-3,
        0.1,
    )


def test_hessian_is_symmetric_positive_and_sums_the_rows(plane_scene):
    level, T_WC, surface = pair(plane_scene)
    system = icp_system.reference(level, T_WC, surface, **GATES)
    found = associate(level, T_WC, surface, **GATES)
    _, J = point_to_plane(
        *(getattr(found, n)[found.inlier] for n in ("xyz", "surface_xyz", "surface_normal"))
    )
    torch.testing.assert_close(
        system.H,
        sum(torch.outer(row, row) for row in J),
        rtol=1e-10,
        atol=1e-9,
    )
    assert torch.equal(system.H, system.H.T)
    assert float(torch.linalg.eigvalsh(system.H)[0]) > 0
    assert (
        system.n_inliers == int(found.inlier.sum()) <= system.n_overlap == int(found.overlap.sum())
    )
    assert system.sum_weights == system.n_inliers
    assert system.rms_m == pytest.approx(math.sqrt(system.sum_squares_m2 / system.n_inliers))


def test_weights_fall_with_the_fourth_power_of_depth():
    z = torch.tensor([0.5, 1.0, 2.0, 4.0])
    torch.testing.assert_close(
        depth_weight(z, 1.0),
        torch.tensor([1.0, 1.0, 1 / 16, 1 / 256]),
    )
    assert depth_weight(z, None).tolist() == [1.0] * 4


def test_nothing_to_match(plane_scene):
    level, T_WC, surface = pair(plane_scene)
    away = T_WC.clone()
    away[:3, 3] += 50.0
    system = icp_system.reference(level, away, surface, **GATES)
    assert (system.n_inliers, system.rms_m) == (0, math.inf)
    assert not system.H.any()


def test_eigenvalues_do_not_depend_on_the_place_or_the_size_of_the_scene(generator):
    xyz = torch.randn(200, 3, generator=generator).double()
    n = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator).double(), dim=-1)
    found = []
    for scale, shift in ((1.0, 0.0), (5.0, 100.0)):
        p = scale * xyz + shift
        r, J = point_to_plane(p, p, n)
        extent = Extent(
            centre=p.mean(0),
            spread_m=float((p - p.mean(0)).square().sum(1).mean().sqrt()),
        )
        found.append(
            solve_step(system_of(J, r), extent, damping=0.0, min_eigenvalue=0.0).eigenvalues
        )
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-9)
    assert 1.0 < float(found[0].sum()) < 2.0
