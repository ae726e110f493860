"""Matching and relative poses from exact and from noisy geometry."""

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking.features import Features
from gsfusion_nb.tracking.landmark_pose import LandmarkRows
from gsfusion_nb.tracking.matching import (
    MAX_HAMMING,
    _clear_and_mutual,
    match_features,
    refine_pose,
    relative_pose,
)
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=210.0,
    cx=160.0,
    cy=121.0,
)


def features(descriptors, uv=None, xyz_C=None):
    n = len(descriptors)
    return Features(
        uv=torch.zeros(n, 2) if uv is None else uv.float(),
        descriptors=descriptors,
        xyz_C=torch.zeros(n, 3) if xyz_C is None else xyz_C.float(),
        has_depth=torch.full((n,), xyz_C is not None),
        sigma_px=torch.ones(n),
    )


def random_descriptors(n, generator):
    return torch.randint(
        0,
        256,
        (n, 32),
        generator=generator,
        dtype=torch.uint8,
    )


def two_views(n, generator, T_RQ):
    """Random points in front of a reference camera, seen exactly by both."""
    xyz_R = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [2.0, 1.5, 2.0]
    )
    xyz_R = xyz_R + torch.tensor([-1.0, -0.75, 1.5])
    xyz_Q = se3.apply(se3.inverse(T_RQ), xyz_R)
    return xyz_R, xyz_Q


@pytest.fixture
def T_RQ():
    return se3.exp(torch.tensor([0.2, -0.1, 0.15, 0.1, -0.2, 0.05], dtype=torch.float64))


def rows_at(xyz_R, uv, depth_m):
    inverse = torch.where(depth_m > 0, 1 / depth_m, 0.0)
    return LandmarkRows(
        camera=CAMERA,
        xyz_W=xyz_R.numpy(),
        uv=uv.numpy(),
        inverse_depth=inverse.numpy(),
        sigma_px=torch.ones(len(uv), dtype=torch.float64).numpy(),
    )


def test_refinement_reaches_the_exact_pose_despite_outliers(generator, T_RQ):
    xyz_R, xyz_Q = two_views(60, generator, T_RQ)
    uv = project(CAMERA, xyz_Q)
    uv[:12] += 40.0
    start = T_RQ @ se3.exp(torch.full((6,), 0.02, dtype=torch.float64))
    rows = torch.arange(60)[:, None].expand(60, 2)
    pose = refine_pose(rows_at(xyz_R, uv, xyz_Q[:, 2]), start, rows)
    assert pose is not None
    assert pose.rows[:, 0].tolist() == list(range(12, 60))
    torch.testing.assert_close(pose.T_RQ, T_RQ, atol=2e-3, rtol=0)
    assert (torch.linalg.eigvalsh(pose.information) > 0).all()


def test_information_is_the_inverse_covariance(generator, T_RQ):
    """Poses from many noisy copies of one measurement scatter as the information says."""
    xyz_R, xyz_Q = two_views(80, generator, T_RQ)
    spread = []
    rows = torch.zeros(80, 2, dtype=torch.int64)
    informations = []
    for _ in range(60):
        noise = torch.randn(80, 2, generator=generator, dtype=torch.float64)
        seen = rows_at(
            xyz_R,
            project(CAMERA, xyz_Q) + noise,
            torch.zeros(80, dtype=torch.float64),
        )
        pose = refine_pose(seen, T_RQ, rows)
        assert pose is not None
        step = se3.inverse(T_RQ) @ pose.T_RQ
        R = step[:3, :3]
        spread.append(torch.tensor([R[2, 1], R[0, 2], R[1, 0], *step[:3, 3]]))
        informations.append(pose.information)
    xi = torch.stack(spread)
    chi2 = torch.einsum("ni,nij,nj->n", xi, torch.stack(informations), xi).mean()
    assert 4.0 < float(chi2) < 9.0  # 6 is exact; weights below 1 make the information cautious


def test_relative_pose_from_descriptors_alone(generator, T_RQ):
    """100 points in both views, 60 unrelated ones besides."""
    xyz_R, xyz_Q = two_views(100, generator, T_RQ)
    same = random_descriptors(100, generator)
    other = torch.rand(60, 3, generator=generator, dtype=torch.float64) + torch.tensor(
        [-0.5, -0.5, 1.5]
    )
    query_xyz = torch.cat([xyz_Q, other])
    reference_xyz = torch.cat([xyz_R, other])
    query = features(
        torch.cat([same, random_descriptors(60, generator)]), project(CAMERA, query_xyz), query_xyz
    )
    reference = features(
        torch.cat([same, random_descriptors(60, generator)]),
        project(CAMERA, reference_xyz),
        reference_xyz,
    )
    pose = relative_pose(CAMERA, query, reference)
    assert pose is not None
    assert len(pose.rows) == 100
    torch.testing.assert_close(pose.T_RQ, T_RQ, atol=1e-4, rtol=0)


def test_match_by_hand():
    """Row 0 matches row 1. Row 1 has two equally near candidates, row 2 nothing within 64 bits."""
    zero = torch.zeros(32, dtype=torch.uint8)
    one = torch.full((32,), 255, dtype=torch.uint8)
    half = zero.clone()
    half[:16] = 255
    mixed = zero.clone()
    mixed[::2] = 255
    near_zero = zero.clone()
    near_zero[0] = 1
    query = features(torch.stack([zero, half, mixed]))
    reference = features(torch.stack([one, near_zero, half, half]))
    assert match_features(query, reference).tolist() == [[0, 1]]


@pytest.mark.parametrize("first", [0, 1])
def test_clear_and_mutual_by_hand(first):
    """Of the candidates of a, the nearest, unless another is nearly as near, or it is nearer to
    another of a."""
    a = np.array([0, 0, 1, 2, 2, 3, 4]) + first
    b = np.array([0, 1, 2, 3, 4, 3, 5])
    distance = np.array([10, 40, 20, 30, 31, 5, MAX_HAMMING + 1])
    found = _clear_and_mutual(a, b, distance)
    assert sorted(found.tolist()) == [0, 2, 5]


@pytest.mark.parametrize(
    ("n", "m"),
    [(0, 5), (5, 0), (1, 1), (1, 5)],
)
def test_too_few_to_match(n, m, generator):
    a = features(random_descriptors(n, generator))
    b = features(random_descriptors(m, generator))
    assert match_features(a, b).shape == (0, 2)
    assert relative_pose(CAMERA, a, b) is None
