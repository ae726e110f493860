"""Bundle adjustment on simulated observations: exact data are a fixed point, noise is averaged."""

import dataclasses

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking.bundle_adjustment import adjust
from gsfusion_nb.tracking.edges import Edge, odometry_information
from gsfusion_nb.tracking.landmark_pose import CAUCHY, LandmarkRows, landmark_pose, landmark_sums
from gsfusion_nb.tracking.landmarks import Observations
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=210.0,
    cx=161.0,
    cy=119.0,
)
HELD = torch.tensor([True] + [False] * 4)


def off(T_WC, true):
    steps = [se3.motion(a, b) for a, b in zip(true, T_WC, strict=True)]
    return max(m for _, m in steps), max(d for d, _ in steps)


@pytest.fixture
def scene(generator):
    """Five views along a path and 60 points; every view sees two of three points; a tenth of the
    depths are missing."""
    points = torch.rand(60, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor(
        [-1.0, -1.0, 2.0]
    )
    step = torch.tensor([0.1, 0.02, 0.03, 0.01, -0.04, 0.02], dtype=torch.float64)
    T_WC = torch.stack([se3.exp(k * step) for k in range(5)])
    keyframe, landmark = (
        x.flatten() for x in torch.meshgrid(torch.arange(5), torch.arange(60), indexing="ij")
    )
    observed = (keyframe + landmark) % 3 > 0
    keyframe = keyframe[observed]
    landmark = landmark[observed]
    xyz_C = torch.stack(
        [
            se3.apply(se3.inverse(T_WC[k]), points[m])
            for k, m in zip(keyframe, landmark, strict=True)
        ]
    )
    seen = Observations(
        keyframe=keyframe,
        landmark=landmark,
        uv=project(CAMERA, xyz_C),
        depth_m=xyz_C[:, 2] * (torch.arange(len(xyz_C)) % 10 > 0),
        sigma_px=torch.ones(len(xyz_C), dtype=torch.float64),
        xyz_W=points,
        name=torch.arange(60),
    )
    return T_WC, seen


def disturbed(scene, generator):
    T_WC, seen = scene
    noise = 0.02 * torch.randn(5, 6, generator=generator, dtype=torch.float64)
    noise[0] = 0
    points = seen.xyz_W + 0.03 * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    return T_WC @ se3.exp(noise), dataclasses.replace(seen, xyz_W=points)


def test_exact_observations_bring_poses_and_points_back(scene, generator):
    T_WC, seen = scene
    found = adjust(CAMERA, *disturbed(scene, generator), [], HELD, iterations=20)
    assert max(off(found.T_WC, T_WC)) < 1e-4
    torch.testing.assert_close(found.xyz_W, seen.xyz_W, atol=1e-4, rtol=0)
    assert found.error_after < 1e-6 * found.error_before
    again = adjust(CAMERA, T_WC, seen, [], HELD)
    torch.testing.assert_close(again.T_WC, T_WC, atol=1e-9, rtol=0)


def test_with_fixed_poses_only_points_move(scene, generator):
    T_WC, seen = scene
    _, start = disturbed(scene, generator)
    found = adjust(
        CAMERA,
        T_WC,
        start,
        [],
        torch.ones(5, dtype=torch.bool),
        iterations=20,
    )
    assert torch.equal(found.T_WC, T_WC)
    torch.testing.assert_close(found.xyz_W, seen.xyz_W, atol=1e-4, rtol=0)


def test_wrong_matches_are_outweighed(scene, generator):
    """A tenth of the pixels are anywhere: that costs less than half of the accuracy that there is
    without them."""
    T_WC, _ = scene
    start, seen = disturbed(scene, generator)
    uv = seen.uv + 0.5 * torch.randn(len(seen), 2, generator=generator, dtype=torch.float64)
    wrong = uv.clone()
    wrong[::10] += 40 * torch.randn(
        len(uv[::10]),
        2,
        generator=generator,
        dtype=torch.float64,
    )
    good, bad = (
        adjust(
            CAMERA,
            start,
            dataclasses.replace(seen, uv=x),
            [],
            HELD,
            iterations=20,
        )
        for x in (uv, wrong)
    )
    assert off(good.T_WC, T_WC)[0] < 0.02
    assert off(bad.T_WC, T_WC)[0] < 1.5 * off(good.T_WC, T_WC)[0]


T_TRUE = se3.exp(torch.tensor([0.4, -0.3, 0.2, 0.3, -0.8, 0.2], dtype=torch.float64))


@pytest.fixture
def rows(generator):
    """40 exact landmarks; every fourth without depth."""
    xyz_C = torch.rand(40, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor(
        [-1.0, -1.0, 1.5]
    )
    inverse = 1 / xyz_C[:, 2] * (torch.arange(40) % 4 > 0)
    return LandmarkRows(
        camera=CAMERA,
        xyz_W=se3.apply(T_TRUE, xyz_C).numpy(),
        uv=project(CAMERA, xyz_C).numpy(),
        inverse_depth=inverse.numpy(),
        sigma_px=np.full(40, 1.5),
    )


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_the_gradient_is_that_of_the_robust_errors(rows, backend):
    """b = 1/2 d/dxi of c^2 ln(1 + |e|^2 / c^2), for a twist about any point."""
    T_WC = T_TRUE @ se3.exp(
        torch.tensor([0.02, 0.01, -0.03, 0.01, 0.02, -0.01], dtype=torch.float64)
    )
    centre = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)

    def cost(xi):
        moved = se3.translate(se3.exp(xi) @ se3.translate(T_WC, -centre), centre)
        e, _, _ = rows.errors(moved)
        return float((CAUCHY**2 * np.log1p((e * e).sum(1) / CAUCHY**2)).sum())

    with use_backend(backend):
        sums = landmark_sums(rows, T_WC, centre)
    steps = 1e-6 * torch.eye(6, dtype=torch.float64)
    slope = torch.tensor(
        [(cost(s) - cost(-s)) / 2e-6 for s in steps],
        dtype=torch.float64,
    )
    torch.testing.assert_close(2 * sums.b, slope, rtol=1e-5, atol=1e-3)
    assert float(torch.linalg.eigvalsh(sums.H)[0]) > 0


def test_the_pose_survives_wrong_matches(rows, generator, assert_pose):
    uv = rows.uv.copy()
    uv[:12] += 15 * torch.randn(12, 2, generator=generator).numpy()
    start = T_TRUE @ se3.exp(
        torch.tensor([0.03, -0.02, 0.04, 0.02, 0.03, -0.03], dtype=torch.float64)
    )
    spoiled = LandmarkRows(
        camera=CAMERA,
        xyz_W=rows.xyz_W,
        uv=uv,
        inverse_depth=rows.inverse_depth,
        sigma_px=rows.sigma_px,
    )
    found = landmark_pose(spoiled, start)
    assert_pose(found, T_TRUE, 4e-3, 0.2)
    assert spoiled.agree(found)[12:].all()
    assert spoiled.agree(found)[:12].mean() < 0.3


def test_relative_poses_hold_what_no_landmark_sees(scene, generator):
    """The last view sees nothing: it keeps its place beside the view before."""
    T_WC, _ = scene
    start, seen = disturbed(scene, generator)
    kept = seen.keyframe < 4
    columns = {
        name: getattr(seen, name)[kept]
        for name in ("keyframe", "landmark", "uv", "depth_m", "sigma_px")
    }
    edge = Edge(
        i=3,
        j=4,
        T_ij=se3.inverse(T_WC[3]) @ T_WC[4],
        information=odometry_information(0.2, 0.01),
        kind="odometry",
    )
    found = adjust(
        CAMERA,
        start,
        dataclasses.replace(seen, **columns),
        [edge],
        HELD,
        iterations=20,
    )
    assert max(off(found.T_WC, T_WC)) < 1e-4


def test_without_any_landmark_the_edges_decide(scene):
    """A back end whose keyframes show nothing twice has poses and edges alone."""
    T_WC, seen = scene
    none = Observations(**{name: column[:0] for name, column in vars(seen).items()})
    near = odometry_information(0.2, 0.01)
    edges = [
        Edge(
            i=k,
            j=k + 1,
            T_ij=se3.inverse(T_WC[k]) @ T_WC[k + 1],
            information=near,
            kind="odometry",
        )
        for k in range(4)
    ]
    start = T_WC.clone()
    start[4, :3, 3] += 0.1
    assert max(off(adjust(CAMERA, start, none, edges, HELD, iterations=20).T_WC, T_WC)) < 1e-4
