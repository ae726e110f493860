"""Eq. 9 by hand."""

import math

import pytest
import torch

from gsfusion_nb.gaussians import fuse_with_history
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.types import GaussianParams


def params(
    value: float, quat: tuple[float, ...], n: int = 1, opacity_logit: float = 0.0
) -> GaussianParams:
    return GaussianParams(
        xyz_W=torch.full((n, 3), value),
        log_scale=torch.full((n, 3), value - 5),
        quat=torch.tensor([quat]).repeat(n, 1),
        opacity_logit=torch.full((n,), opacity_logit),
        sh=torch.full((n, 4, 3), 10 * value),
    )


def about_z(degrees: float) -> tuple[float, ...]:
    half = math.radians(degrees) / 2
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def counts(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int32)


def angle_z(quat: torch.Tensor) -> float:
    R = quaternion.to_matrix(quat)
    return math.degrees(math.atan2(float(R[1, 0]), float(R[0, 0])))


def test_by_hand():
    """eta 30 before, 40 after: w_curr = 10 / 40, so a quarter of the way from before to after."""
    before = params(0.0, about_z(10))
    after = params(1.0, about_z(90), opacity_logit=3.0)
    fused = fuse_with_history(before, after, counts(30), counts(40))
    torch.testing.assert_close(fused.xyz_W, torch.full((1, 3), 0.25))
    torch.testing.assert_close(fused.log_scale, torch.full((1, 3), -4.75))
    torch.testing.assert_close(fused.sh, torch.full((1, 4, 3), 2.5))
    assert angle_z(fused.quat[0]) == pytest.approx(30.0, abs=1e-4)  # 10 + (90 - 10) / 4
    assert fused.opacity_logit.tolist() == [3.0]


def test_each_row_has_its_own_weight():
    """The released code gives scales and colours the first row's."""
    before = params(0.0, about_z(0), n=3)
    after = params(1.0, about_z(80), n=3)
    fused = fuse_with_history(
        before,
        after,
        counts(0, 10, 10),
        counts(50, 20, 10),
    )
    for values in (
        fused.xyz_W[:, 0],
        fused.log_scale[:, 0] + 5,
        fused.sh[:, 0, 0] / 10,
        fused.sh[:, 3, 2] / 10,
    ):
        torch.testing.assert_close(values, torch.tensor([1.0, 0.5, 0.0]))
    assert [round(angle_z(q), 3) for q in fused.quat] == [80.0, 40.0, 0.0]


def test_a_row_without_a_past_keeps_the_new():
    fused = fuse_with_history(
        params(0.0, about_z(0)),
        params(1.0, about_z(50)),
        counts(0),
        counts(17),
    )
    torch.testing.assert_close(fused.xyz_W, torch.ones(1, 3))
    assert angle_z(fused.quat[0]) == pytest.approx(50.0, abs=1e-4)
    never_seen = fuse_with_history(
        params(0.0, about_z(0)),
        params(1.0, about_z(50)),
        counts(0),
        counts(0),
    )
    torch.testing.assert_close(never_seen.xyz_W, torch.ones(1, 3))


def test_the_past_can_be_capped():
    before = params(0.0, about_z(0), n=2)
    after = params(1.0, about_z(60), n=2)
    fused = fuse_with_history(
        before, after, counts(90, 10), counts(100, 100), history_max_weight=0.5
    )
    torch.testing.assert_close(fused.xyz_W[:, 0], torch.tensor([0.5, 0.9]))
    assert [round(angle_z(q), 3) for q in fused.quat] == [30.0, 54.0]


def test_orientations_meet_on_the_shorter_arc(generator):
    """q and -q are one orientation; the fused one lies between, at the weight's share of the
    angle."""
    a, b = torch.randn(2, 20, 4, generator=generator, dtype=torch.float64)
    before = params(0.0, about_z(0), n=20)
    after = params(1.0, about_z(0), n=20)
    before, after = (
        GaussianParams(**{k: v.double() for k, v in vars(p).items()} | {"quat": q})
        for p, q in ((before, -a), (after, b))
    )
    fused = fuse_with_history(
        before,
        after,
        counts(*[25] * 20),
        counts(*[100] * 20),
    )
    R_a, R_b, R = (quaternion.to_matrix(q) for q in (a, b, fused.quat))
    whole = se3.rotation_angle(R_a.transpose(1, 2) @ R_b)
    torch.testing.assert_close(se3.rotation_angle(R_a.transpose(1, 2) @ R), 0.75 * whole)
    torch.testing.assert_close(se3.rotation_angle(R_b.transpose(1, 2) @ R), 0.25 * whole)
