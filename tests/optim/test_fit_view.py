"""A view whose pose is a little wrong finds its way back to the map."""

import dataclasses

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.geometry import backproject, pixel_grid, project, se3
from gsfusion_nb.optim import (
    apply_exposure,
    apply_exposure_vjp,
    fit_exposure,
    fit_pose,
    flow_of_motion,
    pose_step,
    pose_system,
)
from gsfusion_nb.optim.fit_view import fit_pose_by_flow
from gsfusion_nb.optim.pose_system import PIXELS_PER_OBSERVATION, SMALL_RESIDUAL, image_gradient
from gsfusion_nb.render import pose_vjp, render, render_forward, render_vjp
from gsfusion_nb.render.constants import SHOWN_ALPHA
from gsfusion_nb.types import Camera, GaussianParams


@pytest.fixture(scope="module")
def map_and_frame():
    config = gsfusion(
        "online",
        data__width=80,
        data__height=60,
        data__hold_out_every=0,
        seeding__quadtree_threshold=0.03,
        seeding__quadtree_contrast="std",
        tsdf__voxel_size_m=0.04,
    )
    frames = open_sequence("room", data=config.data, n_frames=240).mapping
    mapper = GSFusion(config)
    for i in range(3):
        mapper.step(frames[i])
    return mapper.gaussians.params, frames[1]


def off_by(a, b):
    """Millimetres and degrees between two poses."""
    xi = se3.log(se3.inverse(a.double()) @ b.double())
    return 1e3 * float(xi[:3].norm()), float(xi[3:].norm().rad2deg())


@pytest.mark.parametrize("axis", range(6))
def test_a_disturbed_pose_is_found_again(map_and_frame, axis):
    params, frame = map_and_frame
    picture = render(params, frame.camera, frame.T_WC).rgb
    xi = torch.zeros(6)
    xi[axis] = 0.01
    fit = fit_pose(params, frame.camera, picture, frame.T_WC @ se3.exp(xi))
    mm, degrees = off_by(frame.T_WC, fit.T_WC)
    assert fit.mse_after < 0.01 * fit.mse_before
    assert mm < 5
    assert degrees < 0.15


def test_the_given_pose_stays_where_nothing_is_better(map_and_frame):
    params, frame = map_and_frame
    empty = GaussianParams(**{name: column[:0] for name, column in vars(params).items()})
    fit = fit_pose(empty, frame.camera, frame.rgb, frame.T_WC)
    assert torch.equal(fit.T_WC, frame.T_WC)
    assert fit.mse_before == fit.mse_after
    with pytest.raises(ValueError, match="evaluations"):
        fit_pose(params, frame.camera, frame.rgb, frame.T_WC, evaluations=0)


CAMERA = Camera(
    width=64,
    height=48,
    fx=55.0,
    fy=58.0,
    cx=31.0,
    cy=25.0,
)
LOOSE = torch.tensor([1.0] * 6, dtype=torch.float64)


@pytest.fixture(scope="module")
def scene(request):
    """A few hundred smooth Gaussians on a slanted wall, float64, and a pose of the camera before
    it."""
    g = torch.Generator().manual_seed(1)
    n = 500
    uniform = torch.rand(n, 3, generator=g, dtype=torch.float64)
    xyz = torch.stack(
        [3 * uniform[:, 0] - 1.5, 2.4 * uniform[:, 1] - 1.2, 2 + 0.4 * uniform[:, 0]],
        dim=1,
    )
    quat = torch.zeros(n, 4, dtype=torch.float64)
    quat[:, 0] = 1.0
    params = GaussianParams(
        xyz_W=xyz,
        log_scale=torch.full((n, 3), 0.12, dtype=torch.float64).log(),
        quat=quat,
        opacity_logit=torch.full((n,), 1.0, dtype=torch.float64),
        sh=torch.randn(n, 1, 3, generator=g, dtype=torch.float64),
    )
    return params, torch.eye(4, dtype=torch.float64)


def test_flow_is_the_derivative_of_the_projection():
    depth_m = 1 + torch.rand(
        48, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    along_u, along_v = flow_of_motion(depth_m, CAMERA)
    X = backproject(CAMERA, pixel_grid(CAMERA, dtype=torch.float64), depth_m)
    for v, u in ((3, 5), (40, 60)):

        def seen(xi, X=X[v, u]):
            return -project(CAMERA, se3.apply(se3.exp(-xi), X[None]))[0]

        J = torch.autograd.functional.jacobian(seen, torch.zeros(6, dtype=torch.float64))
        torch.testing.assert_close(
            torch.stack([along_u[v, u], along_v[v, u]]),
            J,
        )


def test_the_system_agrees_with_the_exact_gradient(scene):
    """The sum over pixels of weight, flow and residual is dL/dxi where the picture is smooth."""
    params, T_WC = scene
    target = render(
        params,
        CAMERA,
        T_WC @ se3.exp(torch.tensor([0.01, -0.008, 0.02, 0.004, 0.006, -0.01]).double()),
    ).rgb
    output, saved = render_forward(params, CAMERA, T_WC)
    system = pose_system(output, target, CAMERA)
    r = output.rgb - target
    w = (output.alpha >= SHOWN_ALPHA)[..., None] / r.abs().clamp_min(SMALL_RESIDUAL)
    unit = 1 / (3 * PIXELS_PER_OBSERVATION * system.error.clamp_min(SMALL_RESIDUAL))
    exact = pose_vjp(params, render_vjp(saved, unit * w * r), T_WC)
    assert torch.nn.functional.cosine_similarity(system.g, exact, dim=0) > 0.98
    assert 0.8 < float(system.g.norm() / exact.norm()) < 1.25


def test_a_few_steps_find_the_pose(scene):
    params, T_true = scene
    target = render(params, CAMERA, T_true).rgb
    T_WC = T_start = T_true @ se3.exp(torch.tensor([0.02, -0.02, 0.02, 0.01, 0.01, -0.02]).double())
    systems = []
    for _ in range(6):
        systems.append(pose_system(render(params, CAMERA, T_WC), target, CAMERA))
        T_WC = pose_step(systems[-1], T_WC, T_WC, LOOSE)
    assert systems[-1].error < 0.02 * systems[0].error
    off = [se3.log(se3.inverse(T_true) @ T).norm() for T in (T_start, T_WC)]
    assert off[1] < 0.05 * off[0]


def test_a_tight_prior_holds_and_an_empty_picture_returns_to_it(scene):
    params, T_true = scene
    target = render(params, CAMERA, T_true).rgb
    given = T_true @ se3.exp(torch.tensor([0.02, 0, 0, 0, 0.01, 0]).double())
    tight = pose_step(
        pose_system(render(params, CAMERA, given), target, CAMERA), given, given, 1e-5 * LOOSE
    )
    assert (tight - given).abs().max() < 2e-5
    nothing = dataclasses.replace(
        render(params, CAMERA, T_true), alpha=torch.zeros(48, 64).double()
    )
    system = pose_system(nothing, target, CAMERA)
    assert system.share == 0
    back = pose_step(system, T_true, given, LOOSE)
    torch.testing.assert_close(back, given)


def test_gradient_against_autograd_and_finite_differences():
    g = torch.Generator().manual_seed(0)
    rgb, v = torch.rand(
        2,
        5,
        7,
        3,
        generator=g,
        dtype=torch.float64,
    )
    exposure = torch.tensor([0.8, 1.1, 1.3], dtype=torch.float64)
    v_rgb, v_exposure = apply_exposure_vjp(rgb, exposure, v)
    x = rgb.clone().requires_grad_()
    y = exposure.clone().requires_grad_()
    torch.testing.assert_close(
        (v_rgb, v_exposure),
        torch.autograd.grad((apply_exposure(x, y) * v).sum(), (x, y)),
    )
    h = 1e-6
    for c in range(3):
        step = h * torch.eye(3, dtype=torch.float64)[c]
        difference = (
            (apply_exposure(rgb, exposure + step) - apply_exposure(rgb, exposure - step)) * v
        ).sum() / (2 * h)
        torch.testing.assert_close(v_exposure[c], difference)


def test_the_factors_are_found_where_the_map_shows_something_and_nothing_is_white():
    g = torch.Generator().manual_seed(1)
    rgb = torch.rand(60, 80, 3, generator=g)
    exposure = torch.tensor([0.7, 1.2, 1.5])
    target = (rgb * exposure).clamp(max=1)
    shown = torch.ones(60, 80, dtype=torch.bool)
    shown[:20] = False
    target[:20] = 0.1
    torch.testing.assert_close(
        fit_exposure(rgb, target, shown),
        exposure,
        atol=0.02,
        rtol=0,
    )
    assert torch.equal(fit_exposure(rgb, target, ~shown & shown), torch.ones(3))


def test_differences_of_a_slanted_picture_are_its_slope():
    u, v = torch.meshgrid(
        torch.arange(9.0),
        torch.arange(7.0),
        indexing="xy",
    )
    rgb = torch.stack(
        [0.02 * u, 0.03 * v, 0.01 * u - 0.04 * v],
        dim=-1,
    )
    gx, gy = image_gradient(rgb)
    torch.testing.assert_close(
        gx[:, 1:-1],
        torch.tensor([0.02, 0.0, 0.01]).expand(7, 7, 3),
    )
    torch.testing.assert_close(
        gy[1:-1],
        torch.tensor([0.0, 0.03, -0.04]).expand(5, 9, 3),
    )
    assert not gx[:, [0, -1]].any()
    assert not gy[[0, -1]].any()
    some = image_gradient(rgb, 2)
    torch.testing.assert_close(
        some,
        (gx[::2, ::2], gy[::2, ::2]),
    )


def test_information_is_the_weighted_square_of_what_a_motion_changes(scene):
    """H = sum over pixels and channels of w (g_u a + g_v b)(g_u a + g_v b)^T, one pixel after the
    other."""
    params, T_WC = scene
    output = render(params, CAMERA, T_WC)
    target = output.rgb.roll(1, dims=1)
    system = pose_system(output, target, CAMERA)
    every = 2
    a, b = flow_of_motion(
        output.depth_m[::2, ::2] / output.alpha[::2, ::2].clamp_min(1e-6),
        CAMERA,
        every,
    )
    gx, gy = image_gradient((output.rgb + target) / 2, every)
    r = (output.rgb - target)[::2, ::2]
    shown = output.alpha[::2, ::2] >= SHOWN_ALPHA
    H = torch.zeros(6, 6).double()
    g = torch.zeros(6).double()
    total = 0.0
    for v, u in shown.nonzero().tolist():
        for c in range(3):
            moves = gx[v, u, c] * a[v, u] + gy[v, u, c] * b[v, u]
            w = 1 / max(abs(float(r[v, u, c])), SMALL_RESIDUAL)
            H += w * torch.outer(moves, moves)
            g += w * r[v, u, c] * moves
            total += abs(float(r[v, u, c]))
    error = total / (3 * int(shown.sum()))
    unit = every**2 / (3 * PIXELS_PER_OBSERVATION * error)
    assert float(system.error) == pytest.approx(error)
    assert float(system.share) == pytest.approx(float(shown.double().mean()))
    torch.testing.assert_close(system.H, unit * H)
    torch.testing.assert_close(system.g, unit * g)


def test_a_pose_is_found_without_any_gradient_of_the_map(scene):
    params, T_true = scene
    target = render(params, CAMERA, T_true).rgb
    start = T_true @ se3.exp(torch.tensor([0.02, -0.02, 0.02, 0.01, 0.01, -0.02]).double())
    fit = fit_pose_by_flow(lambda camera, T_WC: render(params, camera, T_WC), CAMERA, target, start)
    assert fit.mse_before == pytest.approx(
        float((render(params, CAMERA, start).rgb - target).square().mean())
    )
    assert fit.mse_after < 0.1 * fit.mse_before
    assert off_by(T_true, fit.T_WC)[0] < 0.5 * off_by(T_true, start)[0]
    assert off_by(T_true, fit.T_WC)[1] < 0.5 * off_by(T_true, start)[1]
    with pytest.raises(ValueError, match="steps must be >= 1, got 0"):
        fit_pose_by_flow(
            lambda camera, T_WC: render(params, camera, T_WC), CAMERA, target, start, steps=0
        )


def test_of_all_poses_tried_the_best_is_kept_and_a_bad_way_is_left(scene):
    """The first picture is a little off, the second one more than half as much again: it is the
    last one."""
    params, T_WC = scene
    picture = render(params, CAMERA, T_WC)
    asked = []

    def worse(camera, pose):
        asked.append(pose)
        return dataclasses.replace(picture, rgb=picture.rgb + 0.1 * len(asked))

    fit = fit_pose_by_flow(worse, CAMERA, picture.rgb, T_WC)
    assert len(asked) == 2
    assert torch.equal(fit.T_WC, T_WC)
    assert fit.mse_before == fit.mse_after == pytest.approx(0.01)


def test_gain_is_the_least_squares_fit_with_a_prior_of_ten_grey_pixels():
    """Every second pixel of every second row, without white ones and those that the map does not
    show."""
    g = torch.Generator().manual_seed(2)
    rgb, target = 1.1 * torch.rand(
        2,
        6,
        8,
        3,
        generator=g,
        dtype=torch.float64,
    )
    target = target.clamp(max=1)
    target[2, 4] = 0.979
    target[4, 2] = 0.981
    shown = torch.rand(6, 8, generator=g) < 0.8
    shown[2, 4] = shown[4, 2] = True
    exposures = []
    for c in range(3):
        # a quarter is the square of grey, a quarter of the pixels is used
        above = below = 10 / 4 / 4
        for v in range(0, 6, 2):
            for u in range(0, 8, 2):
                if shown[v, u] and float(target[v, u].max()) < 0.98:
                    r = min(max(float(rgb[v, u, c]), 0.0), 1.0)
                    above += r * float(target[v, u, c])
                    below += r * r
        exposures.append(above / below)
    assert fit_exposure(rgb, target, shown).tolist() == pytest.approx(exposures)
