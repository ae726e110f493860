"""gsplat's strategies as rules: which rows change, by hand and against gsplat itself; and that they
run online."""

import dataclasses
import math
import warnings
from typing import Any

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.seeding import (
    SeedContext,
    StepStats,
    abs_image_gradient,
    image_gradient,
    restart_statistics,
)
from gsfusion_nb.seeding.points import add_up
from gsfusion_nb.seeding.rules import default_strategy, mcmc
from gsfusion_nb.types import Seeds

N = 40


@pytest.fixture(scope="module")
def frame() -> Any:
    return room(n_frames=120, width=32, height=24)[0]


@pytest.fixture
def model(generator) -> GaussianModel:
    """Rows of all sizes and opacities, each visible in four steps, with gradients around the
    threshold."""
    made = GaussianModel(sh_degree=1)
    seeds = Seeds.isotropic(
        torch.rand(N, 3, generator=generator),
        torch.rand(N, 3, generator=generator),
        0.02 * torch.rand(N, generator=generator) + 0.001,
    )
    opacity = torch.rand(N, generator=generator) ** 4 * 0.99 + 0.001
    made.append(Seeds(**vars(seeds) | {"opacity": opacity}))
    made.params.log_scale.add_(0.5 * torch.randn(N, 3, generator=generator))
    return made


def told(frame: Any, step: int, **more: Any) -> StepStats:
    return StepStats(
        step=step,
        stage="online",
        step_in_frame=1,
        steps_in_frame=1,
        frame_index=0,
        camera=frame.camera,
        T_WC=frame.T_WC,
        target=frame.rgb,
        loss=torch.zeros(()),
        **more,
    )


def seen(
    model: GaussianModel, frame: Any, generator: torch.Generator, steps: int = 4
) -> torch.Tensor:
    """Statistics of some steps; returns the gradients [steps, N, 2], in units of half the image."""
    restart_statistics(model)
    half = torch.tensor([frame.camera.width / 2, frame.camera.height / 2])
    gradients = 4e-4 * torch.rand(steps, N, 2, generator=generator)
    for g in gradients:
        add_up(
            model,
            torch.ones(N, dtype=torch.bool),
            g / half,
            frame.camera,
        )
    return gradients


def refined(
    rule: Any, model: GaussianModel, frame: Any, step: int, generator: torch.Generator, **more
) -> Any:
    ctx = SeedContext(frame, gaussians=model, generator=generator)
    return rule.after_step(
        ctx,
        told(frame, step, **more),
        {"step": step - 2},
    )


@pytest.mark.parametrize("absgrad", [False, True])
def test_small_ones_are_copied_large_ones_split_faint_ones_removed(
    model, frame, generator, absgrad
):
    seen(model, frame, generator)
    decides, other = ("image_gradient", "abs_image_gradient")[:: -1 if absgrad else 1]
    model.row_memory(other).fill_(1.0)
    p = model.params
    p.log_scale.fill_(math.log(0.005))
    p.opacity_logit.fill_(0.0)
    p.log_scale[1] = math.log(0.02)
    p.log_scale[2] = math.log(0.5)
    p.opacity_logit[3] = -6.0
    model.row_memory(decides).zero_()[:3] = 4 * 3e-4
    rule = default_strategy(scene_scale_m=1.0, reset_every=600, absgrad=absgrad)
    assert rule.statistics() == {f"{decides}s"}
    edit = refined(rule, model, frame, 701, generator)
    assert edit is not None
    assert edit.clone.nonzero()[:, 0].tolist() == [0]
    # the halves of row 2 would still be too large
    assert edit.split.nonzero()[:, 0].tolist() == [1]
    assert (~edit.keep).nonzero()[:, 0].tolist() == [2, 3]
    assert not model.memory[decides].any()
    assert edit.reset_opacity is None


@pytest.mark.parametrize(
    ("step", "grows", "resets"),
    [
        (401, False, False),
        (501, False, False),
        (601, True, False),
        (650, False, False),
        (3001, True, True),
        (3101, False, False),
        (3301, True, False),
        (15001, False, False),
    ],
)
def test_when_it_refines_and_resets(model, frame, generator, step, grows, resets):
    seen(model, frame, generator)
    rule = default_strategy(pause_refine_after_reset=200 if step > 3001 else 0)
    edit = refined(rule, model, frame, step, generator)
    assert (edit is not None and edit.keep is not None) == grows
    assert (edit is not None and edit.reset_opacity == 0.01) == resets


@pytest.fixture(scope="module")
def gsplat() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip(
            "gsplat.strategy", reason="gsplat is not installed: pip install gsplat==1.5.3"
        )


def theirs(model: GaussianModel) -> tuple[Any, dict[str, torch.optim.Optimizer]]:
    p = model.params
    columns = {
        "means": p.xyz_W,
        "scales": p.log_scale,
        "quats": p.quat,
        "opacities": p.opacity_logit,
        "sh": p.sh,
    }
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(column.clone()) for name, column in columns.items()}
    )
    return params, {name: torch.optim.Adam([param], lr=0.0) for name, param in params.items()}


def assert_same(model: GaussianModel, params: Any, n_drawn: int = 0) -> None:
    """Equal rows; the centres of the last ``n_drawn`` were drawn at random, by each from other
    numbers."""
    p = model.params
    columns = {
        "means": p.xyz_W,
        "scales": p.log_scale,
        "quats": p.quat,
        "opacities": p.opacity_logit,
        "sh": p.sh,
    }
    for name, column in columns.items():
        assert column.shape == params[name].shape
        rows = slice(len(column) - n_drawn if name == "means" else None)
        torch.testing.assert_close(
            column[rows],
            params[name].data[rows],
            atol=1e-5,
            rtol=1e-5,
        )


@pytest.mark.parametrize("sizes_in_2d", [0, 10_000])
@pytest.mark.parametrize("revised", [False, True])
@pytest.mark.parametrize("step", [700, 3200])
def test_grows_and_prunes_the_same_rows_as_gsplat(
    gsplat, model, frame, generator, step, revised, sizes_in_2d
):
    options = {
        "revised_opacity": revised,
        "refine_scale2d_stop_iter": sizes_in_2d,
        "prune_scale3d": 0.015,
    }
    rule = default_strategy(scene_scale_m=1.3, grow_grad2d=2.5e-4, **options)
    gradients = seen(model, frame, generator)
    large = model.scale_m.amax(dim=1) > 0.013
    radius_px = torch.where(large, 8 * torch.rand(N, generator=generator), 0.0)
    strategy = gsplat.DefaultStrategy(grow_grad2d=2.5e-4, **options)
    state = {
        "grad2d": gradients.norm(dim=2).sum(0),
        "count": torch.full((N,), 4.0),
        "scene_scale": 1.3,
    }
    if sizes_in_2d:
        state["radii"] = radius_px / 32
    params, optimisers = theirs(model)
    ours = torch.Generator().manual_seed(3)
    edit = refined(rule, model, frame, step + 1, ours, radius_px=radius_px)
    assert edit is not None
    model.edit(edit, ours)
    n_copied, n_split = strategy._grow_gs(params, optimisers, state, step)
    n_removed = strategy._prune_gs(params, optimisers, state, step)
    assert min(n_copied, n_split, n_removed) > 0
    assert_same(model, params, n_drawn=2 * int(edit.split.sum()))


def test_moves_and_adds_the_same_rows_as_gsplat(gsplat, model, frame, monkeypatch):
    import gsplat.strategy.ops as ops  # pyright: ignore[reportMissingImports]

    def relocation(opacities, scales, ratios, binoms):
        from gsfusion_nb.gaussians import shared

        return shared(opacities, scales, ratios, 1e-9)

    # its formula: tests/gaussians/test_edit.py
    monkeypatch.setattr(ops, "compute_relocation", relocation)
    strategy = gsplat.MCMCStrategy(min_opacity=0.01, cap_max=41)
    params, optimisers = theirs(model)
    ours = torch.Generator().manual_seed(3)
    edit = refined(
        mcmc(min_opacity=0.01, cap_max=41, noise_lr=0.0),
        model,
        frame,
        601,
        ours,
    )
    assert edit is not None
    model.edit(edit, ours)
    torch.manual_seed(3)
    binoms = strategy.initialize_state()["binoms"]
    n_moved = strategy._relocate_gs(params, _with_moments(params, optimisers), binoms)
    n_added = strategy._add_new_gs(params, optimisers, binoms)
    assert n_moved > 3
    assert n_added == 1
    assert_same(model, params)


def _with_moments(
    params: Any, optimisers: dict[str, torch.optim.Optimizer]
) -> dict[str, torch.optim.Optimizer]:
    for name, optimiser in optimisers.items():
        params[name].grad = torch.zeros_like(params[name])
        optimiser.step()
    return optimisers


def test_the_random_motion_is_gsplat_s(gsplat, model, frame):
    import gsplat.strategy.ops as ops  # pyright: ignore[reportMissingImports]

    params, optimisers = theirs(model)
    ours = torch.Generator().manual_seed(3)
    edit = refined(mcmc(), model, frame, 7, ours)
    assert edit is not None
    assert edit.relocate is edit.clone is None
    torch.manual_seed(3)
    covariance = ops.quat_scale_to_covar_preci
    ops.quat_scale_to_covar_preci = _covariance
    try:
        ops.inject_noise_to_position(params, optimisers, {}, 1.6e-4 * 5e5)
    finally:
        ops.quat_scale_to_covar_preci = covariance
    rows, values = edit.set["xyz_W"]
    assert rows.tolist() == list(range(N))
    torch.testing.assert_close(values, params["means"].data, atol=1e-6, rtol=1e-5)


def _covariance(quats, scales, **_):
    """gsplat's function is a CUDA kernel: R diag(s^2) R^T of wxyz quaternions."""
    from gsplat.utils import normalized_quat_to_rotmat  # pyright: ignore[reportMissingImports]

    R = normalized_quat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
    return R @ torch.diag_embed(scales**2) @ R.mT, None


@pytest.mark.parametrize("absgrad", [False, True])
def test_gradients_are_summed_up_as_in_gsplat(gsplat, model, frame, generator, absgrad):
    strategy = gsplat.DefaultStrategy(absgrad=absgrad)
    state = strategy.initialize_state()
    params, _ = theirs(model)
    for _ in range(3):
        visible = torch.rand(N, generator=generator) < 0.7
        v_uv = 1e-4 * torch.randn(N, 2, generator=generator)
        v_uv_abs = v_uv.abs() * (1 + torch.rand(N, 2, generator=generator))
        add_up(model, visible, v_uv, frame.camera, v_uv_abs)
        means2d: Any = torch.zeros(1, N, 2, requires_grad=True)
        means2d.grad = v_uv[None].clone()
        means2d.absgrad = v_uv_abs[None].clone()
        size = {"width": frame.camera.width, "height": frame.camera.height, "n_cameras": 1}
        radii = (visible[:, None] * torch.tensor([2, 3]))[None]
        strategy._update_state(
            params, state, size | {"means2d": means2d, "radii": radii, "gaussian_ids": None}
        )
    found = abs_image_gradient(model) if absgrad else image_gradient(model)
    torch.testing.assert_close(found, state["grad2d"] / state["count"].clamp_min(1))


def test_motion_is_large_only_for_transparent_ones_and_has_the_shape_of_the_gaussian(
    model, frame, generator
):
    model.params.opacity_logit.copy_(torch.where(torch.arange(N) < 20, -9.0, 2.0))
    model.params.log_scale.copy_(torch.tensor([0.1, 0.001, 0.001]).log().expand(N, 3))
    model.params.quat.copy_(torch.tensor([1.0, 0, 0, 0]).expand(N, 4))
    edit = refined(mcmc(lr_xyz=1e-3, noise_lr=1e3), model, frame, 7, generator)
    assert edit is not None
    away = (edit.set["xyz_W"][1] - model.params.xyz_W).abs()
    assert float(away[20:].max()) < 1e-6
    assert float(away[:20, 0].median()) > 1e-3
    assert float(away[:20, 1:].max()) < 1e-5


@pytest.mark.parametrize(
    ("revised", "removed"),
    [(False, [3]), (True, [1, 3])],
)
def test_halves_are_judged_by_their_own_opacity(model, frame, generator, revised, removed):
    """Of an opacity of 0.0075 a revised half has 1 - sqrt(1 - 0.0075) = 0.0038, below the limit of
    0.005. Row 0 is not split; row 3 is too faint itself."""
    seen(model, frame, generator)
    model.params.log_scale.fill_(math.log(0.02))
    model.params.opacity_logit.fill_(0.0)
    model.params.opacity_logit[:2] = math.log(0.0075 / 0.9925)
    model.params.opacity_logit[3] = -6.0
    model.row_memory("image_gradient").zero_()[1:3] = 4 * 3e-4
    rule = default_strategy(scene_scale_m=1.0, revised_opacity=revised)
    edit = refined(rule, model, frame, 701, generator)
    assert edit is not None
    assert (~edit.keep).nonzero()[:, 0].tolist() == removed
    assert edit.split.nonzero()[:, 0].tolist() == [row for row in (1, 2) if row not in removed]
    assert edit.split_shares == revised


@pytest.mark.parametrize(
    ("step", "stop", "split", "removed"),
    [
        (701, 10_000, [1, 2, 4], []),  # before the first reset nothing is too large
        (3201, 10_000, [1, 4], [2, 3]),
        (3201, 0, [4], [3]),  # sizes in the image do not count
    ],
)
def test_large_ones_in_the_image_or_the_scene(model, frame, generator, step, stop, split, removed):
    """Rows 1 and 2 are 0.1 and 0.2 of the image's longer side wide, the limits are 0.05 and 0.15;
    row 3 is 0.11 of the scene, the limit is 0.1; row 4 is 0.12, but its halves are smaller."""
    seen(model, frame, generator)
    model.params.log_scale.fill_(math.log(0.005))
    model.params.log_scale[3] = math.log(0.11)
    model.params.log_scale[4] = math.log(0.12)
    model.params.opacity_logit.fill_(0.0)
    model.row_memory("image_gradient").zero_()[4] = 4 * 3e-4
    radius_px = torch.zeros(N)
    radius_px[1:3] = torch.tensor([0.1, 0.2]) * frame.camera.width
    rule = default_strategy(scene_scale_m=1.0, refine_scale2d_stop_iter=stop)
    edit = refined(rule, model, frame, step, generator, radius_px=radius_px)
    assert edit is not None
    assert edit.split.nonzero()[:, 0].tolist() == split
    assert (~edit.keep).nonzero()[:, 0].tolist() == removed
    assert not edit.clone.any()


@pytest.mark.parametrize(
    ("cap", "added"),
    [(1_000_000, 2), (41, 1), (40, 0), (30, 0)],  # 5 % of 40, as far as there is room
)
def test_faint_ones_move_and_some_are_added_up_to_the_cap(model, frame, generator, cap, added):
    model.params.opacity_logit.fill_(0.0)
    model.params.opacity_logit[[3, 5]] = -7.0
    rule = mcmc(cap_max=cap, noise_lr=0.0)
    edit = refined(rule, model, frame, 601, generator)
    assert edit is not None
    dead_rows, targets = edit.relocate
    assert dead_rows.tolist() == [3, 5]
    assert not {3, 5} & set(targets.tolist())
    assert (0 if edit.clone is None else len(edit.clone)) == added
    if added:
        assert edit.clone_shares


@pytest.mark.parametrize(
    ("step", "moves"),
    [(401, False), (501, False), (601, True), (650, False), (24_901, True), (25_001, False)],
)
def test_when_faint_ones_move(model, frame, generator, step, moves):
    model.params.opacity_logit[3] = -7.0
    edit = refined(mcmc(noise_lr=0.0), model, frame, step, generator)
    assert (edit is not None) == moves


def test_seeds_stop_at_the_cap(model, frame, generator):
    """Of 40 rows behind the camera and a cap of 45 there is room for 5."""
    behind = frame.T_WC[:3, 3] - 5.0 * frame.T_WC[:3, 2]
    model.params.xyz_W.copy_(behind.expand(N, 3))
    ctx = SeedContext(frame, gaussians=model, generator=generator)
    empty = SeedContext(frame, gaussians=GaussianModel(sh_degree=1), generator=generator)
    for cap, n in ((45, 5), (40, 0), (30, 0)):
        assert len(mcmc(share=0.5, cap_max=cap).seeds(ctx, {})) == n
        assert len(mcmc(share=0.5, cap_max=cap).seeds(empty, {})) == cap


def test_the_scene_is_as_large_as_the_way_of_the_camera(frame, model):
    """1.1 times the largest distance of a camera from the mean of all, at least one metre."""
    past = []
    for x in (0.0, 4.0):
        T_WC = torch.eye(4)
        T_WC[0, 3] = x
        past.append(T_WC)
    here = dataclasses.replace(frame, T_WC=torch.eye(4))
    rule = default_strategy()
    far = SeedContext(here, gaussians=model, past_T_WC=tuple(past))
    assert rule._scene_m(far) == pytest.approx(1.1 * (4 - 4 / 3))
    assert rule._scene_m(SeedContext(here, gaussians=model)) == 1.0
    assert default_strategy(scene_scale_m=7.0)._scene_m(far) == 7.0


def test_steps_that_are_told_twice_refine_once(frame, model, generator):
    """The memory says what was done; a window of several steps that passes a multiple refines at
    its end."""
    rule = default_strategy(scene_scale_m=1.0, refine_every=100)
    memory = {"step": 640}
    ctx = SeedContext(frame, gaussians=model, generator=generator)
    seen(model, frame, generator)
    assert rule.after_step(ctx, told(frame, 696), memory) is None
    assert memory == {"step": 695}
    seen(model, frame, generator)
    assert rule.after_step(ctx, told(frame, 705), memory) is not None
    assert memory == {"step": 704}
    seen(model, frame, generator)
    assert rule.after_step(ctx, told(frame, 711), memory) is None
