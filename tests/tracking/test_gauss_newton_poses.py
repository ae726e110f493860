"""The hand-written pose graph: derivatives, and the optimum that GTSAM finds."""

import pytest
import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import Edge, odometry_information, optimise_poses_plain, pose_graph_step, relative_pose_error
from gsfusion_nb.tracking.pose_graph import optimise_poses

F64 = torch.float64


def shift(x):
    T = torch.eye(4, dtype=F64)
    T[0, 3] = x
    return T


def ring(n, generator, sigma_deg=0.5, sigma_m=0.01):
    """True poses around a circle, measured steps with noise, and the poses that follow from these."""
    xi = torch.zeros(n, 6, dtype=F64)
    xi[:, 4] = torch.arange(n) / n * 2 * torch.pi
    true = se3.exp(xi)
    true[:, :3, 3] = torch.stack([xi[:, 4].sin(), 0 * xi[:, 4], xi[:, 4].cos()], 1) * 2
    scale = torch.tensor([sigma_m] * 3 + [sigma_deg / 57.3] * 3, dtype=F64)
    noise = torch.randn(n, 6, generator=generator, dtype=F64) * scale
    drifted, edges = [true[0]], []
    for k in range(1, n):
        T_ij = se3.inverse(true[k - 1]) @ true[k] @ se3.exp(noise[k])
        edges.append(Edge(i=k - 1, j=k, T_ij=T_ij, information=odometry_information(sigma_deg, sigma_m),
                          kind="odometry"))  # fmt: skip
        drifted.append(drifted[-1] @ T_ij)
    return true, torch.stack(drifted), edges


def loop(true, i, j):
    T_ij = se3.inverse(true[i]) @ true[j]
    return Edge(i=i, j=j, T_ij=T_ij, information=odometry_information(0.1, 0.002), kind="loop")


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
            moved = [[T_i @ se3.exp(s * xi), T_j] if end == 0 else [T_i, T_j @ se3.exp(s * xi)] for s in (1, -1)]
            ahead, back = (relative_pose_error(*ends, T_ij)[0] for ends in moved)
            torch.testing.assert_close(J[:, k], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-6)


def test_the_adjoint_moves_a_twist_to_the_other_side(generator):
    T, xi = se3.exp(torch.randn(6, generator=generator, dtype=F64)), torch.randn(6, generator=generator, dtype=F64)
    torch.testing.assert_close(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T)
    torch.testing.assert_close(se3.adjoint(se3.exp(xi)), torch.linalg.matrix_exp(se3.small_adjoint(xi)))


def test_a_contradiction_is_shared_by_the_steps_in_proportion_to_their_variance():
    """Two steps of 1 m, the second twice as uncertain, and a loop that says 2.5 m: 0.5 m is shared 1 to 4."""
    steps = [Edge(i=k, j=k + 1, T_ij=shift(1.0), information=odometry_information(1.0, s), kind="odometry")
             for k, s in ((0, 1.0), (1, 2.0))]  # fmt: skip
    sure = Edge(i=0, j=2, T_ij=shift(2.5), information=odometry_information(1e-3, 1e-4), kind="odometry")
    T_WC = optimise_poses_plain(torch.stack([shift(0.0), shift(1.0), shift(2.0)]), [*steps, sure]).T_WC
    torch.testing.assert_close(T_WC[:, 0, 3], torch.tensor([0.0, 1.1, 2.5], dtype=F64), rtol=0, atol=1e-3)


def test_one_step_solves_a_small_loop_and_the_first_pose_stays(generator):
    true, drifted, edges = ring(6, generator, 0.05, 0.001)
    edges = [*edges, loop(true, 0, 5)]
    i, j = (torch.tensor([getattr(e, end) for e in edges]) for end in ("i", "j"))
    e, J_i, J_j = relative_pose_error(drifted[i], drifted[j], torch.stack([e.T_ij for e in edges]))
    after = pose_graph_step(drifted, i, j, e, J_i, J_j, torch.eye(6, dtype=F64).repeat(len(edges), 1, 1))
    e_after, *_ = relative_pose_error(after[i], after[j], torch.stack([e.T_ij for e in edges]))
    assert torch.equal(after[0], drifted[0])
    assert float(e_after.square().sum()) < 0.3 * float(e.square().sum())


@pytest.mark.parametrize("false_loop", [False, True])
def test_it_finds_the_optimum_of_gtsam(generator, false_loop):
    pytest.importorskip("gtsam", reason="the extra 'slam' is not installed")
    true, drifted, edges = ring(16, generator)
    edges = [*edges, loop(true, 0, 14), loop(true, 1, 15)]
    if false_loop:
        edges.append(Edge(i=3, j=9, T_ij=shift(0.1), information=odometry_information(0.1, 0.002), kind="loop"))
    ours, theirs = optimise_poses_plain(drifted, edges), optimise_poses(drifted, edges)
    assert ours.error_before == pytest.approx(theirs.error_before, rel=1e-6)
    assert ours.error_after == pytest.approx(theirs.error_after, rel=1e-3)
    torch.testing.assert_close(ours.T_WC, theirs.T_WC, rtol=0, atol=2e-3)
    assert float((ours.T_WC - true).norm()) < 0.7 * float((drifted - true).norm())


def test_without_edges_nothing_moves():
    assert torch.equal(optimise_poses_plain(shift(1.0)[None], []).T_WC, shift(1.0)[None])
    step = Edge(i=0, j=1, T_ij=shift(1.0), information=odometry_information(1.0, 1.0), kind="odometry")
    with pytest.raises(torch.linalg.LinAlgError):
        optimise_poses_plain(torch.stack([shift(0.0), shift(1.0), shift(2.0)]), [step])
