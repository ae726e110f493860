"""Trajectory errors: known transforms come back, by-hand values, and agreement with evo where it is
installed."""

import math

import pytest
import torch
from jaxtyping import TypeCheckError

from gsfusion_nb.evaluation import align_umeyama, ate_rmse, rpe, trajectory_scores
from gsfusion_nb.geometry import se3


def random_path(generator, n=40):
    """A smooth path: accumulated small motions."""
    step = torch.randn(n, 6, generator=generator, dtype=torch.float64) * torch.tensor(
        [0.1] * 3 + [0.05] * 3
    )
    poses = [torch.eye(4, dtype=torch.float64)]
    for xi in step[1:]:
        poses.append(poses[-1] @ se3.exp(xi))
    return torch.stack(poses)


def perturbed(path, generator, size=0.01):
    xi = (
        torch.randn(
            len(path),
            6,
            generator=generator,
            dtype=torch.float64,
        )
        * size
    )
    return path @ se3.exp(xi)


def test_ate_by_hand_without_alignment():
    reference = torch.eye(4).repeat(2, 1, 1)
    estimate = reference.clone()
    estimate[0, 0, 3] = 3.0
    estimate[1, 1, 3] = 4.0
    assert ate_rmse(estimate, reference, align=False) == pytest.approx(math.sqrt((9 + 16) / 2))


def test_a_rigid_motion_of_the_world_is_aligned_away(generator):
    path = random_path(generator)
    T = se3.exp(torch.tensor([1.0, -2.0, 0.5, 0.4, 1.2, -2.0], dtype=torch.float64))
    moved = T @ path
    assert ate_rmse(moved, path, align=False) > 0.5
    assert ate_rmse(moved, path) == pytest.approx(0, abs=1e-12)
    R, t = align_umeyama(path[:, :3, 3], moved[:, :3, 3])
    assert torch.allclose(R, T[:3, :3], atol=1e-12)
    assert torch.allclose(t, T[:3, 3], atol=1e-12)


def test_alignment_never_mirrors(generator):
    xyz = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    mirrored = xyz * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert torch.linalg.det(align_umeyama(xyz, mirrored)[0]) == pytest.approx(1.0)


def test_alignment_is_the_least_squares_optimum(generator):
    path = random_path(generator)
    noisy = perturbed(path, generator, 0.05)
    R, t = align_umeyama(noisy[:, :3, 3], path[:, :3, 3])

    def cost(R, t):
        return float((noisy[:, :3, 3] @ R.T + t - path[:, :3, 3]).square().sum())

    for xi in 1e-3 * torch.eye(6, dtype=torch.float64):
        T = se3.exp(xi)
        assert cost(T[:3, :3] @ R, t + T[:3, 3]) > cost(R, t)


def test_rpe_by_hand():
    """A drift of 1 cm and 1 degree a frame."""
    reference = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    xi = torch.tensor(
        [0.0, 0.0, 0.01, 0.0, 0.0, math.radians(1)],
        dtype=torch.float64,
    )
    estimate = torch.stack([se3.exp(i * xi) for i in range(5)])
    assert rpe(estimate, reference) == (pytest.approx(0.01), pytest.approx(1.0))


@pytest.mark.parametrize("align", [False, True])
def test_ate_agrees_with_evo(generator, align):
    metrics, paths = evo()
    path = random_path(generator)
    estimate = se3.exp(torch.tensor([0.3, 0, 1, 0, 1, 0], dtype=torch.float64)) @ perturbed(
        path, generator
    )
    theirs_ref = evo_path(paths, path)
    theirs = evo_path(paths, estimate)
    if align:
        theirs.align(theirs_ref)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((theirs_ref, theirs))
    ours = ate_rmse(estimate, path, align=align)
    assert ours == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_rpe_agrees_with_evo(generator):
    metrics, paths = evo()
    path = random_path(generator)
    estimate = perturbed(path, generator)
    for relation, value in zip(
        ("translation_part", "rotation_angle_deg"), rpe(estimate, path), strict=True
    ):
        theirs = metrics.RPE(
            getattr(metrics.PoseRelation, relation),
            delta=1,
            delta_unit=metrics.Unit.frames,
            all_pairs=True,
        )
        theirs.process_data((evo_path(paths, path), evo_path(paths, estimate)))
        assert value == pytest.approx(theirs.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def evo():
    core = pytest.importorskip("evo.core", reason="evo is not installed; it is only a witness")
    from evo.core import metrics, trajectory  # pyright: ignore[reportMissingImports]

    assert core
    return metrics, trajectory


def evo_path(paths, poses):
    return paths.PosePath3D(poses_se3=list(poses.numpy().copy()))


def test_impossible_requests_are_sentences(generator):
    path = random_path(generator, 5)
    with pytest.raises(ValueError, match="at least one pose"):
        ate_rmse(path[:0], path[:0])
    with pytest.raises(ValueError, match="at least 3 positions, got 2"):
        ate_rmse(path[:2], path[:2])
    with pytest.raises(ValueError, match="estimate must be finite"):
        ate_rmse(path * float("nan"), path)
    with pytest.raises((ValueError, TypeCheckError)):
        ate_rmse(path[:3], path)


def test_scores_by_name(generator):
    """A path whose world is moved rigidly and whose last pose is 5 cm off."""
    path = random_path(generator)
    T = se3.exp(torch.tensor([0.2, 0.1, -0.3, 0.1, 0.2, -0.1], dtype=torch.float64))
    moved = T @ path
    exact = trajectory_scores(moved, path)
    assert exact["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert exact["ate_mean_m"] == pytest.approx(0, abs=1e-9)
    assert exact["rpe_translation_m"] == pytest.approx(0, abs=1e-9)
    assert exact["rpe_rotation_deg"] == pytest.approx(0, abs=1e-5)
    # of the end, not aligned
    assert exact["drift_m"] == pytest.approx(float((moved - path)[-1, :3, 3].norm()))

    off = path.clone()
    off[-1, :3, 3] += torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    scores = trajectory_scores(off, path)
    assert scores["drift_m"] == pytest.approx(0.05)
    assert scores["ate_rmse_m"] == pytest.approx(ate_rmse(off, path))
    assert 0 < scores["ate_mean_m"] < scores["ate_rmse_m"]
    assert scores["rpe_translation_m"] == pytest.approx(0.05 / math.sqrt(len(path) - 1))
    assert scores["rpe_rotation_deg"] == pytest.approx(0, abs=1e-5)


def test_noise_of_known_size_is_measured(generator):
    path = random_path(generator, 2000)
    estimate = path.clone()
    estimate[:, :3, 3] += 0.02 * torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    assert ate_rmse(estimate, path) == pytest.approx(0.02 * math.sqrt(3), rel=0.05)


def test_scores_of_too_short_a_path():
    with pytest.raises(ValueError, match="at least 3 positions, got 2"):
        trajectory_scores(
            torch.eye(4).repeat(2, 1, 1),
            torch.eye(4).repeat(2, 1, 1),
        )


@pytest.mark.parametrize("score", [ate_rmse, rpe, trajectory_scores])
@pytest.mark.parametrize("which", [0, 1])
def test_every_score_refuses_poses_that_are_not_finite(score, which, generator):
    paths = [random_path(generator, 5), random_path(generator, 5)]
    paths[which][2, 0, 3] = torch.inf
    with pytest.raises(ValueError, match=("estimate", "reference")[which] + " must be finite"):
        score(*paths)
    with pytest.raises(ValueError, match="at least one pose, got none"):
        score(paths[0][:0], paths[1][:0])
