"""Hits, disc depth and its gradient on the CPU kernels against the reference."""

import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.render import disc_depth, disc_depth_vjp, render_forward
from gsfusion_nb.types import Camera, GaussianParams

pytest.importorskip("numba")

T_WC = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.3, 0.1]))
SIZES = [(0, 32, 16), (1, 16, 16), (37, 33, 17), (900, 95, 61)]


def scene(n: int, generator: torch.Generator) -> GaussianParams:
    """Discs of all inclinations in front of the camera and behind it; about half can be hit."""

    def normal(*size: int):
        return torch.randn(*size, generator=generator)

    in_camera = torch.stack(
        [1.2 * normal(n), 1.2 * normal(n), 2.0 + 1.5 * normal(n)],
        dim=-1,
    )
    return GaussianParams(
        xyz_W=se3.apply(T_WC, in_camera),
        log_scale=math.log(0.1) + 0.5 * normal(n, 3),
        quat=quaternion.normalise(normal(n, 4)) * (0.5 + torch.rand(n, 1, generator=generator)),
        opacity_logit=3.0 * normal(n),
        sh=0.4 * normal(n, 1, 3),
    )


@pytest.mark.parametrize(("n", "width", "height"), SIZES)
def test_frozen_rows_have_no_gradient(n, width, height, generator, make_camera):
    params = scene(n, generator)
    camera = make_camera(width, height)
    v = torch.randn(height, width, generator=generator)
    rows = torch.rand(n, generator=generator) < 0.4
    with use_backend("numba"):
        hit_index = render_forward(params, camera, T_WC, opaque_alpha=0.6)[0].hit_index
        given = params, camera, T_WC, hit_index, v
        full = disc_depth_vjp(*given)
        found = disc_depth_vjp(*given, rows=rows)
        with pytest.raises(ValueError, match="rows must be boolean"):
            disc_depth_vjp(*given, rows=rows.int())
    with use_backend("reference"):
        expected = disc_depth_vjp(*given, rows=rows)
    for f, x, e in zip(full, found, expected, strict=True):
        assert torch.equal(x, torch.where(rows[:, None], f, 0.0))
        assert (x - e).norm() <= 1e-4 * e.norm() + 1e-6
    assert n < 900 or all(x.any() for x in found)


def layers(*opacity: float) -> GaussianParams:
    """Wide Gaussians one behind the other, on the axis of a camera at the origin."""
    n = len(opacity)
    return GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 2.0 + 0.01 * i] for i in range(n)]),
        log_scale=torch.full((n, 3), math.log(2.0)),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4),
        opacity_logit=torch.tensor(opacity).logit(),
        sh=torch.zeros(n, 1, 3),
    )


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_a_finished_pixel_still_finds_its_hit(backend):
    """Ten half-transparent layers leave 1e-3 of the light, thirteen 1.2e-4; the next may not leave
    less than 1e-4.

    Colour ends there; the hit is the first opaque Gaussian wherever it is (RTG-SLAM, section 3.1).
    """
    camera = Camera(
        width=17,
        height=17,
        fx=17.0,
        fy=17.0,
        cx=8.5,
        cy=8.5,
    )
    half = (0.5,) * 10
    cases = {
        (*half, 0.7): 10,
        (*half, 0.95): 10,
        (*half, *half, 0.7): 20,
        (0.7, *half, 0.7): 0,
        (*half, *half): -1,
    }
    cases[(*half, *half, *half, *half, 0.55, 0.95)] = 41
    with use_backend(backend):
        for opacity, row in cases.items():
            found, _ = render_forward(
                layers(*opacity),
                camera,
                torch.eye(4),
                opaque_alpha=0.6,
            )
            assert found.hit_index[8, 8] == row, opacity
            plain, _ = render_forward(layers(*opacity), camera, torch.eye(4))
            assert torch.equal(found.rgb, plain.rgb)
            assert torch.equal(found.alpha, plain.alpha)


def test_a_plane_met_behind_the_camera_gives_the_centre(make_camera):
    """Normal at 80 degrees from the axis: rays on one side of the image meet the plane behind the
    camera."""
    angle = math.radians(40)
    params = GaussianParams(
        **{**vars(layers(0.9)), "quat": torch.tensor([[math.cos(angle), 0, math.sin(angle), 0]])}
    )
    params = GaussianParams(**{**vars(params), "log_scale": torch.tensor([[0.5, 0.5, 0.01]]).log()})
    camera = make_camera(33, 17)
    hit_index = torch.zeros(17, 33, dtype=torch.int64)
    depths = []
    for backend in ("reference", "numba"):
        with use_backend(backend):
            depths.append(
                disc_depth(
                    params, camera, torch.eye(4), hit_index, max_offset=None, min_cosine=0.05
                ).depth_m
            )
    torch.testing.assert_close(*depths, rtol=1e-4, atol=0)
    X = (torch.arange(33) + 0.5 - camera.cx) / camera.fx
    behind = 1 + X * math.tan(math.radians(80)) < 0
    assert behind.any()
    assert (depths[1][:, behind] == 2).all()
    assert (depths[1] != 2).any()


def test_equal_scales_take_the_first_axis(generator, make_camera):
    params = scene(60, generator)
    params = GaussianParams(**{**vars(params), "log_scale": params.log_scale[:, :1].expand(60, 3)})
    camera = make_camera(33, 17)
    hit_index = torch.randint(-1, 60, (17, 33), generator=generator)
    normals = []
    for backend in ("reference", "numba"):
        with use_backend(backend):
            normals.append(disc_depth(params, camera, T_WC, hit_index).normal_W)
    torch.testing.assert_close(*normals, atol=1e-5, rtol=0)
    axis = quaternion.to_matrix(params.quat)[:, :, 0]
    hit = hit_index >= 0
    torch.testing.assert_close(
        (normals[1][hit] * axis[hit_index[hit]]).sum(-1).abs(),
        torch.ones(int(hit.sum())),
    )
