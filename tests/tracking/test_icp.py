"""Frame-to-model ICP on scenes whose pose is known exactly."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import Surface, align, depth_pyramid, icp

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


@pytest.mark.parametrize(("scene", "open_directions"), [("wall", 3), ("edge", 1), ("corner", 0)])
def test_what_the_scene_does_not_show_is_left_to_the_start(plane_scene, assert_pose, scene, open_directions):
    """A wall hides two translations and the rotation about its normal, an edge the translation along itself."""
    planes = plane_scene(scene)
    T_WC = torch.eye(4).double()
    frame = planes.frame(T_WC)
    start = se3.exp(torch.tensor([0.02, 0.03, -0.04, 0.01, 0.01, 0.0]).double())
    found = icp(frame.depth_m, frame.camera, planes(frame.camera, T_WC), start, EXACT)
    assert found.degenerate == open_directions
    assert [e < 1e-3 * found.eigenvalues[-1] for e in found.eigenvalues] == [i < open_directions for i in range(6)]
    assert found.rms_m < 1e-4
    middle = torch.tensor([[0.0, 0.0, 2.0]]).double()
    before, after = se3.apply(start, middle)[0], se3.apply(found.T_WC, middle)[0]
    turned = se3.log(found.T_WC)[3:]
    if scene == "corner":
        assert_pose(found.T_WC, T_WC, 1e-4, 0.01)
    if scene == "edge":  # what is in the middle of the view stays where the start put it along the edge
        assert float(after[1]) == pytest.approx(float(before[1]), abs=1e-3)
        assert float(after[[0, 2]].sub(middle[0, [0, 2]]).abs().max()) < 1e-3
        assert float(turned.abs().max()) < 1e-3
    if scene == "wall":
        torch.testing.assert_close(after[:2], before[:2], atol=2e-3, rtol=0)
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
    assert [step.factor for step in found.history] == sorted((s.factor for s in found.history), reverse=True)
    assert {step.factor for step in found.history} == {8, 4, 2}
    torch.testing.assert_close(found.history[0].T_WC, start)
    assert found.history[0].rms_m > 20 * found.rms_m
    assert found.history[0].step_m > 0.01 > found.history[-1].step_m
    assert all(0 < step.n_inliers <= step.n_overlap for step in found.history)
    again = icp(frame.depth_m, frame.camera, scene(frame.camera, T_WC), T_WC)
    assert len(again.history) < len(found.history)  # ends as soon as the steps are small


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


def test_a_surface_of_another_size_and_pose(plane_scene, assert_pose):
    scene = plane_scene("corner")
    T_WC = se3.exp(torch.tensor([0.1, 0.05, 0.0, 0.02, 0.05, 0.0]).double())
    frame = scene.frame(T_WC)
    surface = scene(frame.camera.resized(101, 77), torch.eye(4).double())
    assert_pose(icp(frame.depth_m, frame.camera, surface, torch.eye(4), EXACT).T_WC, T_WC, 1e-4, 0.01)


def test_nothing_to_align(plane_scene):
    scene = plane_scene("corner")
    frame = scene.frame(torch.eye(4))
    surface = scene(frame.camera, torch.eye(4))
    blank = dataclasses.replace(surface, depth_m=torch.zeros_like(surface.depth_m))
    start = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]).double())
    for depth_m, target in ((frame.depth_m, blank), (torch.zeros_like(frame.depth_m), surface)):
        found = icp(depth_m, frame.camera, target, start)
        assert (found.n_inliers, found.inlier_share, found.overlap_inlier_share, found.history) == (0, 0.0, 0.0, ())
        assert torch.equal(found.T_WC, start)


@pytest.mark.parametrize("factors", [(7, 3), (5,), (16, 1)])
def test_levels_that_do_not_divide_the_size(plane_scene, generator, assert_pose, factors):
    scene = plane_scene("corner")
    T_WC = torch.eye(4).double()
    frame = scene.frame(T_WC)
    config = TrackingConfig(even_to_m=None, pyramid=factors, iterations=(12,) * len(factors))
    start = perturbation(generator, 0.03, 3.0)
    assert_pose(icp(frame.depth_m, frame.camera, scene(frame.camera, T_WC), start, config).T_WC, T_WC, 2e-3, 0.1)


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
