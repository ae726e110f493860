"""The graph: closed forms, false loops, landmarks with exact sightings."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking import pose_graph_step, relative_pose_error
from gsfusion_nb.tracking.edges import (
    HELD_BY_MAP,
    Edge,
    edge_error,
    fit_odometry,
    odometry_information,
)
from gsfusion_nb.tracking.landmarks import Observations
from gsfusion_nb.tracking.pose_graph import LOOP_CAUCHY, TRACK_HUBER, Optimised, optimise_poses
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=208.0,
    cx=160.0,
    cy=120.0,
)
UNIT = odometry_information(1.0, 0.02)


def edge(i, j, T_ij, information=UNIT, kind: Any = "odometry"):
    return Edge(i=i, j=j, T_ij=T_ij, information=information, kind=kind)


def shift(x):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


def ring(n, generator, sigma_deg=0.2, sigma_m=0.002):
    """True poses around a circle, steps with noise, and the poses that follow from those."""
    angle = torch.arange(n) / n * 2 * torch.pi
    xi = torch.zeros(n, 6, dtype=torch.float64)
    xi[:, 4] = angle
    true = se3.exp(xi)
    true[:, :3, 3] = torch.stack([angle.sin(), 0 * angle, angle.cos()], 1) * 2
    scale = torch.tensor([sigma_m] * 3 + [sigma_deg / 57.3] * 3, dtype=torch.float64)
    noise = torch.randn(n, 6, generator=generator, dtype=torch.float64) * scale
    drifted = [true[0]]
    edges = []
    for k in range(1, n):
        step = se3.inverse(true[k - 1]) @ true[k] @ se3.exp(noise[k])
        edges.append(edge(k - 1, k, step, odometry_information(sigma_deg, sigma_m)))
        drifted.append(drifted[-1] @ step)
    return true, torch.stack(drifted), edges


def off(T, true):
    return float((T[:, :3, 3] - true[:, :3, 3]).norm(dim=1).square().mean().sqrt())


def test_a_true_loop_removes_drift(generator):
    true, drifted, edges = ring(40, generator, sigma_deg=0.5)
    loop = edge(
        0,
        39,
        se3.inverse(true[0]) @ true[39],
        odometry_information(0.05, 0.002),
        "loop",
    )
    result = optimise_poses(drifted, [*edges, loop])
    assert off(result.T_WC, true) < 0.6 * off(drifted, true)
    assert edge_error(loop, result.T_WC) < 1.5


@pytest.mark.parametrize("wrong_m", [0.5, 2.0])
def test_a_false_loop_is_rejected(generator, wrong_m):
    true, drifted, edges = ring(40, generator)
    precise = odometry_information(0.05, 0.002)
    good = [
        edge(
            k,
            k + 30,
            se3.inverse(true[k]) @ true[k + 30],
            precise,
            "loop",
        )
        for k in (0, 5, 9)
    ]
    false = edge(
        3,
        25,
        se3.inverse(true[3]) @ true[25] @ shift(wrong_m),
        precise,
        "loop",
    )
    with_it = optimise_poses(drifted, [*edges, *good, false])
    without = optimise_poses(drifted, [*edges, *good])
    assert off(with_it.T_WC, without.T_WC) < 0.005
    assert edge_error(false, with_it.T_WC) > 50
    trusting = optimise_poses(drifted, [*edges, *good, dataclasses.replace(false, kind="odometry")])
    assert off(trusting.T_WC, true) > 5 * off(with_it.T_WC, true)


@pytest.mark.parametrize(("sigma_deg", "sigma_m"), [(0.3, 0.004), (0.15, 0.01)])
def test_the_precision_of_odometry_is_found(generator, sigma_deg, sigma_m):
    true, _, edges = ring(400, generator, sigma_deg, sigma_m)
    given = odometry_information(2.0, 0.1)
    seen = odometry_information(0.1, 0.003)
    both = [dataclasses.replace(e, information=given) for e in edges]
    for k in range(1, 400):
        noise = torch.randn(6, generator=generator, dtype=torch.float64) * torch.tensor(
            [0.003] * 3 + [0.1 / 57.3] * 3
        )
        both.append(
            edge(
                k - 1,
                k,
                se3.inverse(true[k - 1]) @ true[k] @ se3.exp(noise),
                seen,
                "landmarks",
            )
        )
    sigma = (fit_odometry(both)[0].information.diagonal() / HELD_BY_MAP) ** -0.5
    torch.testing.assert_close(
        sigma[:3] * 57.3,
        torch.full((3,), sigma_deg, dtype=torch.float64),
        rtol=0.15,
        atol=0,
    )
    torch.testing.assert_close(
        sigma[3:],
        torch.full((3,), sigma_m, dtype=torch.float64),
        rtol=0.15,
        atol=0,
    )
    assert fit_odometry(edges) == edges  # nothing to compare with


def sightings(true, generator, points=80, depth_share=0.7):
    xyz_W = (torch.rand(points, 3, generator=generator, dtype=torch.float64) - 0.5) * 2
    rows = []
    for k, T in enumerate(true):
        xyz_C = se3.apply(se3.inverse(T), xyz_W)
        known = torch.rand(points, generator=generator) < depth_share
        rows.append(
            (
                torch.full((points,), k),
                torch.arange(points),
                project(CAMERA, xyz_C),
                xyz_C[:, 2] * known,
            )
        )
    keyframe, landmark, uv, depth_m = (torch.cat(c) for c in zip(*rows, strict=True))
    return Observations(
        keyframe=keyframe,
        landmark=landmark,
        uv=uv,
        depth_m=depth_m,
        sigma_px=torch.ones(len(uv), dtype=torch.float64),
        xyz_W=xyz_W + 0.02 * torch.randn(points, 3, generator=generator, dtype=torch.float64),
        name=torch.arange(points),
    )


F64 = torch.float64


def moved_by(x):
    T = torch.eye(4, dtype=F64)
    T[0, 3] = x
    return T


def circle(n, generator, sigma_deg=0.5, sigma_m=0.01):
    """True poses around a circle, measured steps with noise, and the poses that follow from
    these."""
    xi = torch.zeros(n, 6, dtype=F64)
    xi[:, 4] = torch.arange(n) / n * 2 * torch.pi
    true = se3.exp(xi)
    true[:, :3, 3] = (
        torch.stack(
            [xi[:, 4].sin(), 0 * xi[:, 4], xi[:, 4].cos()],
            1,
        )
        * 2
    )
    scale = torch.tensor([sigma_m] * 3 + [sigma_deg / 57.3] * 3, dtype=F64)
    noise = torch.randn(n, 6, generator=generator, dtype=F64) * scale
    drifted = [true[0]]
    edges = []
    for k in range(1, n):
        T_ij = se3.inverse(true[k - 1]) @ true[k] @ se3.exp(noise[k])
        edges.append(
            Edge(
                i=k - 1,
                j=k,
                T_ij=T_ij,
                information=odometry_information(sigma_deg, sigma_m),
                kind="odometry",
            )
        )
        drifted.append(drifted[-1] @ T_ij)
    return true, torch.stack(drifted), edges


def loop(true, i, j):
    T_ij = se3.inverse(true[i]) @ true[j]
    return Edge(
        i=i,
        j=j,
        T_ij=T_ij,
        information=odometry_information(0.1, 0.002),
        kind="loop",
    )


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_derivatives_of_an_edge_are_those_of_finite_differences(generator, size):
    T_i, T_j, off = se3.exp(0.7 * torch.randn(3, 6, generator=generator, dtype=F64))
    T_ij = se3.inverse(T_i) @ T_j @ se3.exp(size * se3.log(off))
    e, *given = relative_pose_error(T_i, T_j, T_ij)
    assert float(e.norm()) == pytest.approx(size * float(se3.log(off).norm()), abs=1e-9)
    for end, J in enumerate(given):
        for k in range(6):
            xi = torch.zeros(6, dtype=F64)
            xi[k] = 1e-6
            moved = [
                [T_i @ se3.exp(s * xi), T_j] if end == 0 else [T_i, T_j @ se3.exp(s * xi)]
                for s in (1, -1)
            ]
            ahead, back = (relative_pose_error(*ends, T_ij)[0] for ends in moved)
            torch.testing.assert_close(
                J[:, k],
                (ahead - back) / 2e-6,
                rtol=1e-5,
                atol=1e-6,
            )


def test_a_contradiction_is_shared_by_the_steps_in_proportion_to_their_variance():
    """Two steps of 1 m, the second twice as uncertain, and a loop that says 2.5 m: 0.5 m is shared
    1 to 4."""
    steps = [
        Edge(
            i=k,
            j=k + 1,
            T_ij=moved_by(1.0),
            information=odometry_information(1.0, s),
            kind="odometry",
        )
        for k, s in ((0, 1.0), (1, 2.0))
    ]
    sure = Edge(
        i=0,
        j=2,
        T_ij=moved_by(2.5),
        information=odometry_information(1e-3, 1e-4),
        kind="odometry",
    )
    T_WC = optimise_poses(
        torch.stack([moved_by(0.0), moved_by(1.0), moved_by(2.0)]),
        [*steps, sure],
    ).T_WC
    torch.testing.assert_close(
        T_WC[:, 0, 3],
        torch.tensor([0.0, 1.1, 2.5], dtype=F64),
        rtol=0,
        atol=1e-3,
    )


def test_one_step_solves_a_small_loop_and_the_first_pose_stays(generator):
    true, drifted, edges = circle(6, generator, 0.05, 0.001)
    edges = [*edges, loop(true, 0, 5)]
    i, j = (torch.tensor([getattr(e, end) for e in edges]) for end in ("i", "j"))
    e, J_i, J_j = relative_pose_error(
        drifted[i],
        drifted[j],
        torch.stack([e.T_ij for e in edges]),
    )
    after = pose_graph_step(
        drifted,
        i,
        j,
        e,
        J_i,
        J_j,
        torch.eye(6, dtype=F64).repeat(len(edges), 1, 1),
    )
    e_after, *_ = relative_pose_error(
        after[i],
        after[j],
        torch.stack([e.T_ij for e in edges]),
    )
    assert torch.equal(after[0], drifted[0])
    assert float(e_after.square().sum()) < 0.3 * float(e.square().sum())


def by_gtsam(T_WC, edges):
    """The same least squares by the Levenberg-Marquardt steps of GTSAM, from the poses as they
    are."""
    gtsam = pytest.importorskip("gtsam", reason="GTSAM, the second witness, is not installed")
    estimators = gtsam.noiseModel.mEstimator
    graph = gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    for k, T in enumerate(T_WC.numpy()):
        start.insert(k, gtsam.Pose3(T))
    graph.add(
        gtsam.PriorFactorPose3(
            0,
            start.atPose3(0),
            gtsam.noiseModel.Isotropic.Sigma(6, 1e-6),
        )
    )
    for e in edges:
        rho = (
            estimators.Cauchy.Create(LOOP_CAUCHY)
            if e.kind == "loop"
            else estimators.Huber.Create(TRACK_HUBER)
        )
        noise = gtsam.noiseModel.Robust.Create(
            rho, gtsam.noiseModel.Gaussian.Information(e.information.numpy())
        )
        graph.add(
            gtsam.BetweenFactorPose3(
                e.i,
                e.j,
                gtsam.Pose3(e.T_ij.numpy()),
                noise,
            )
        )
    found = gtsam.LevenbergMarquardtOptimizer(
        graph, start, gtsam.LevenbergMarquardtParams()
    ).optimize()
    T_found = torch.stack(
        [torch.from_numpy(np.array(found.atPose3(k).matrix())) for k in range(len(T_WC))]
    )
    return Optimised(
        T_WC=T_found,
        error_before=graph.error(start),
        error_after=graph.error(found),
    )


@pytest.mark.parametrize("false_loop", [False, True])
def test_it_finds_the_optimum_of_gtsam(generator, false_loop):
    true, drifted, edges = circle(16, generator)
    edges = [*edges, loop(true, 0, 14), loop(true, 1, 15)]
    if false_loop:
        edges.append(
            Edge(
                i=3,
                j=9,
                T_ij=moved_by(0.1),
                information=odometry_information(0.1, 0.002),
                kind="loop",
            )
        )
    ours = optimise_poses(drifted, edges)
    theirs = by_gtsam(drifted, edges)
    assert ours.error_before == pytest.approx(theirs.error_before, rel=1e-6)
    assert ours.error_after == pytest.approx(theirs.error_after, rel=1e-3)
    torch.testing.assert_close(ours.T_WC, theirs.T_WC, rtol=0, atol=2e-3)
    assert float((ours.T_WC - true).norm()) < 0.7 * float((drifted - true).norm())
