"""Adam with one constant rate per group, against torch's."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch
from kernel_cases import make_params

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import OptimConfig
from gsfusion_nb.gaussians import Edit, GaussianModel
from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.large_maps import Boxes, MapPart
from gsfusion_nb.optim import (
    AdamSettings,
    ColumnRates,
    adam_step,
    adam_update,
    adam_update_map,
    take_missed_steps,
)
from gsfusion_nb.types import GaussianParams, Seeds

MOMENTS = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}


@pytest.mark.parametrize(
    "shape",
    [(0, 3), (1,), (7, 3), (5, 16, 3)],
)
def test_agrees_with_torch_adam(shape, generator):
    param = torch.randn(shape, generator=generator, dtype=torch.float64)
    ours = param.clone()
    theirs = param.clone().requires_grad_(True)
    m = torch.zeros_like(param)
    v = torch.zeros_like(param)
    optimiser = torch.optim.Adam(
        [theirs],
        lr=1e-2,
        betas=(0.9, 0.999),
        eps=1e-15,
    )
    for t in range(1, 6):
        g = torch.randn(shape, generator=generator, dtype=torch.float64)
        theirs.grad = g.clone()
        optimiser.step()
        adam_update(ours, g, m, v, t, lr=1e-2, **MOMENTS)
    torch.testing.assert_close(ours, theirs.detach())


@pytest.mark.parametrize(
    ("k", "multiple"),
    [(1, 3.162), (2, 4.250), (3, 4.950), (5, 5.797), (10, 6.528), (20, 6.241)],
)
@pytest.mark.parametrize("late", [10**6, None])
def test_newborn_rows_move_faster_without_their_own_correction(k, multiple, late):
    """(1 - 0.9^k) / sqrt(1 - 0.999^k): what the released code gives a Gaussian that joins late."""
    param, m, v = torch.zeros(3, dtype=torch.float64).split(1)
    for _ in range(k):
        before = param.clone()
        adam_update(
            param,
            torch.ones(1, dtype=torch.float64),
            m,
            v,
            late,
            lr=1.0,
            **MOMENTS,
        )
    assert float(before - param) == pytest.approx(multiple, abs=6e-4)


def test_per_row_steps_treat_a_late_row_like_a_first_one(generator):
    grads = torch.randn(4, 2, 3, generator=generator)
    early = torch.zeros(2, 3)
    late = torch.zeros(2, 3)
    m1, v1, m2, v2 = (torch.zeros(2, 3) for _ in range(4))
    for t, g in enumerate(grads, start=1):
        adam_update(early, g, m1, v1, t, lr=0.1, **MOMENTS)
        adam_update(
            late,
            g,
            m2,
            v2,
            torch.tensor([t, t], dtype=torch.int32),
            lr=0.1,
            **MOMENTS,
        )
    torch.testing.assert_close(early, late)


@pytest.mark.parametrize(
    ("t", "factor"),
    [(1, 0.316), (10, 0.153), (210, 0.435), (2000, 0.930), (16000, 1.0)],
)
@pytest.mark.parametrize("age", [0, 7])
def test_a_shared_count_shortens_the_steps_of_new_and_old_rows_alike(t, factor, age, generator):
    """The correction is sqrt(1 - 0.999^t) / (1 - 0.9^t), whatever the age of the row."""
    m = (1 - 0.9**age) * torch.randn(4, generator=generator, dtype=torch.float64)
    v = (1 - 0.999**age) * torch.rand(4, generator=generator, dtype=torch.float64)
    gradient = torch.randn(4, generator=generator, dtype=torch.float64)
    shared, none = torch.zeros(2, 4, dtype=torch.float64)
    adam_update(
        shared,
        gradient,
        m.clone(),
        v.clone(),
        t,
        lr=1.0,
        **MOMENTS,
    )
    adam_update(none, gradient, m, v, None, lr=1.0, **MOMENTS)
    torch.testing.assert_close(
        shared / none,
        torch.full_like(none, factor),
        rtol=0,
        atol=6e-4,
    )


@pytest.mark.parametrize("backend", ["reference", "numba"])
@pytest.mark.parametrize(
    "steps",
    [None, 3, torch.tensor([1, 200, 10**6], dtype=torch.int32)],
)
def test_a_map_is_updated_like_its_columns(backend, steps, generator):
    """Bit for bit; coefficient 0 of SH at its own rate."""
    rates = ColumnRates(
        xyz_W=1e-3, log_scale=2e-3, quat=3e-3, opacity_logit=4e-3, sh_dc=5e-3, sh_rest=6e-3
    )
    sh_rates = torch.full((4, 3), rates.sh_rest)
    sh_rates[0] = rates.sh_dc

    like = vars(make_params(1, "cpu", n=3))
    maps = [
        GaussianParams(**{k: torch.rand(x.shape, generator=generator) for k, x in like.items()})
        for _ in range(4)
    ]
    expected = [{name: column.clone() for name, column in vars(rows).items()} for rows in maps]
    with use_backend(backend):
        adam_update_map(*maps, steps, rates=rates, **MOMENTS)
        for name in PARAMETERS:
            lr = sh_rates if name == "sh" else getattr(rates, name)
            adam_update(*(columns[name] for columns in expected), steps, lr=lr, **MOMENTS)
    for rows, columns in zip(maps, expected, strict=True):
        assert all(torch.equal(getattr(rows, name), columns[name]) for name in PARAMETERS)


def constant_gradients(params: GaussianParams) -> GaussianParams:
    return GaussianParams(**{name: torch.ones_like(getattr(params, name)) for name in PARAMETERS})


@pytest.mark.parametrize(
    ("mode", "multiple"),
    [("shared", 1.0), ("per_row", 1.0), ("none", 0.1 / 0.001**0.5)],
)
def test_each_group_moves_at_its_own_rate(mode, multiple):
    model = GaussianModel(sh_degree=3)
    model.append(
        Seeds.isotropic(
            torch.zeros(2, 3),
            torch.full((2, 3), 0.5),
            torch.ones(2),
        )
    )
    before = dataclasses.replace(
        model.params,
        **{n: getattr(model.params, n).clone() for n in PARAMETERS},
    )
    config = OptimConfig(
        adam_steps=mode,
        lr_xyz=1.6e-4,
        lr_sh_dc=2.5e-3,
        lr_sh_rest=1.25e-4,
        lr_log_scale=1e-3,
        lr_quat=2e-3,
        lr_opacity_logit=5e-2,
    )
    adam_step(model, constant_gradients(model.params), config)
    moved = {n: (getattr(before, n) - getattr(model.params, n)) for n in PARAMETERS}
    expected = {"xyz_W": 1.6e-4, "log_scale": 1e-3, "quat": 2e-3, "opacity_logit": 5e-2}
    for name, lr in expected.items():
        torch.testing.assert_close(
            moved[name],
            torch.full_like(moved[name], lr * multiple),
            rtol=1e-3,
            atol=1e-7,
        )
    torch.testing.assert_close(
        moved["sh"][:, 0],
        torch.full((2, 3), 2.5e-3 * multiple),
        rtol=1e-3,
        atol=1e-7,
    )
    torch.testing.assert_close(
        moved["sh"][:, 1:],
        torch.full((2, 15, 3), 1.25e-4 * multiple),
        rtol=1e-3,
        atol=1e-7,
    )
    assert model.clock.count == 1


def test_late_rows_in_a_shared_model(generator):
    config = OptimConfig(adam_steps="shared", lr_opacity_logit=5e-2)
    model = GaussianModel(sh_degree=0)
    one = Seeds.isotropic(
        torch.zeros(1, 3),
        torch.full((1, 3), 0.5),
        torch.ones(1),
    )
    model.append(one)
    for _ in range(200):
        adam_step(model, constant_gradients(model.params), config)
    model.append(one)
    before = model.params.opacity_logit[1].item()
    adam_step(model, constant_gradients(model.params), config)
    # bias correction of v at t = 201 is 0.182, so the first step is 0.1 / sqrt(0.001 / 0.182) =
    # 1.35 learning rates
    assert before - model.params.opacity_logit[1].item() == pytest.approx(1.3497 * 5e-2, rel=1e-3)


RATES = {"xyz_W": 1e-3, "log_scale": 4e-3, "quat": 2e-3, "sh_dc": 5e-4, "sh_rest": 2.5e-5}


def window_adam(**rates: float) -> AdamSettings:
    """Adam as a window of RTG-SLAM has it: textbook steps, and opacities stay."""
    columns = ColumnRates(opacity_logit=0.0, **RATES | rates)
    return AdamSettings(rates=columns, steps="shared", **MOMENTS)


def copies_of(params: GaussianParams) -> GaussianModel:
    """Rows whose moments begin at zero."""
    model = GaussianModel(params.sh_degree)
    model.extend(params)
    return model


def rows(n: int, generator: torch.Generator, dtype=torch.float32) -> GaussianParams:
    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    return GaussianParams(
        xyz_W=normal(n, 3),
        log_scale=normal(n, 3),
        quat=normal(n, 4),
        opacity_logit=normal(n),
        sh=normal(n, 9, 3),
    )


@pytest.mark.parametrize("n", [0, 1, 11])
def test_twenty_steps_of_torch_adam(n, generator):
    params = rows(n, generator)
    leaves = {
        name: value.clone().requires_grad_() for name, value in vars(params).items() if name != "sh"
    }
    leaves |= {
        "sh_dc": params.sh[:, :1].clone().requires_grad_(),
        "sh_rest": params.sh[:, 1:].clone().requires_grad_(),
    }
    groups = [{"params": [leaves[name]], "lr": lr} for name, lr in RATES.items()]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    born = params.opacity_logit.clone()
    ours = copies_of(params)
    for step in range(20):
        g = rows(n, generator)
        if step % 3 == 0:
            g.xyz_W[: n // 2] = 0.0  # rows that this view does not show
        for name, leaf in leaves.items():
            leaf.grad = {"sh_dc": g.sh[:, :1], "sh_rest": g.sh[:, 1:]}.get(
                name, getattr(g, name, None)
            )
        theirs.step()
        adam_step(ours, g, window_adam())
    for name in ("xyz_W", "log_scale", "quat"):
        torch.testing.assert_close(
            getattr(ours.params, name),
            leaves[name].detach(),
            atol=1e-6,
            rtol=0,
        )
    torch.testing.assert_close(
        ours.params.sh[:, :1],
        leaves["sh_dc"].detach(),
        atol=1e-6,
        rtol=0,
    )
    torch.testing.assert_close(
        ours.params.sh[:, 1:],
        leaves["sh_rest"].detach(),
        atol=1e-6,
        rtol=0,
    )
    assert torch.equal(ours.params.opacity_logit, born)


def test_a_step_on_the_first_rows_leaves_the_others(generator):
    """The optimiser works on the first rows of the picture's Gaussians; those behind are frozen."""
    params = rows(5, generator)
    whole = copies_of(params)
    alone = copies_of(params[:2])
    g = rows(5, generator)
    part = MapPart(whole, torch.arange(2))
    adam_step(part, g[:2], window_adam())
    part.write_back()
    adam_step(alone, g[:2], window_adam())
    for name in PARAMETERS:
        assert torch.equal(getattr(whole.params, name)[:2], getattr(alone.params, name))
        assert torch.equal(getattr(whole.params, name)[2:], getattr(params, name)[2:])


COLUMNS = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


def map_of(generator, n: int = 9) -> GaussianModel:
    model = GaussianModel(sh_degree=1)
    xyz, rgb = (torch.rand(n, 3, generator=generator) for _ in range(2))
    model.append(
        Seeds.isotropic(
            xyz,
            rgb,
            torch.full((n,), 0.05),
        )
    )
    return model


def gradients(params: GaussianParams, generator) -> GaussianParams:
    return GaussianParams(
        **{c: torch.randn(getattr(params, c).shape, generator=generator) for c in COLUMNS}
    )


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_rows_take_their_part_of_the_step(generator, backend):
    """Against a map with another learning rate for all: 0, the same, a third and twice it."""
    factors = torch.tensor([0.0, 1, 1 / 3, 2, 0, 1, 1 / 3, 2, 1])
    model = map_of(generator)
    all_by = {
        f: GaussianModel.from_state_dict(model.state_dict()) for f in factors.unique().tolist()
    }
    model.edit(Edit(rates=dict.fromkeys(COLUMNS, factors)), generator)
    config = OptimConfig()
    with use_backend(backend):
        for _ in range(5):
            g = gradients(model.params, generator)
            adam_step(model, g, config)
            for f, other in all_by.items():
                rates = {
                    name: f * value
                    for name, value in vars(config).items()
                    if name.startswith("lr_")
                }
                adam_step(other, g, dataclasses.replace(config, **rates))
    for name in COLUMNS:
        for f, other in all_by.items():
            rows = factors == f
            found = getattr(model.params, name)[rows]
            expected = getattr(other.params, name)[rows]
            if f in (0.0, 1.0):
                assert torch.equal(found, expected), (name, f)
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)
        assert torch.equal(
            getattr(model.moments.exp_avg_sq, name), getattr(all_by[1.0].moments.exp_avg_sq, name)
        )


def test_the_rows_of_a_window_take_their_part_too(generator):
    params = map_of(generator).params
    adam = window_adam(xyz_W=0.1, log_scale=0.1, quat=0.0, sh_dc=0.1, sh_rest=0.1)
    models = copies_of(params), copies_of(params)
    factor = torch.tensor([0.0, 1, 0.5] * 3)
    for name, factors in {"xyz_W": factor, "quat": factor, "sh": 0 * factor}.items():
        models[1].rates.use(name).copy_(factors)
    g = gradients(params, generator)
    for model in models:
        adam_step(model, g, adam)
    whole, part = (model.params for model in models)
    assert torch.equal(part.sh, params.sh)
    assert torch.equal(part.quat, params.quat)
    assert torch.equal(part.log_scale, whole.log_scale)
    moved = part.xyz_W - params.xyz_W
    expected = whole.xyz_W - params.xyz_W
    torch.testing.assert_close(
        moved,
        factor[:, None] * expected,
        atol=1e-6,
        rtol=0,
    )
    assert torch.equal(moved[1::3], expected[1::3])


@pytest.mark.parametrize("adam_steps", ["none", "shared", "per_row"])
@pytest.mark.parametrize(
    ("missed", "decays"),
    [(1, {}), (7, {}), (400, {}), (400, {"beta1": 0.98, "beta2": 0.99}), (7, {"beta1": 0.5})],
)
def test_missed_steps_are_those_of_the_whole_map(generator, adam_steps, missed, decays):
    config = OptimConfig(adam_steps=adam_steps, **decays)
    whole = GaussianModel(2)
    part = GaussianModel(2)
    for n in (5, 7):  # of two ages
        more = rows(n, generator)
        for model in (whole, part):
            model.extend(more)
        for _ in range(4):
            g = rows(len(whole), generator)
            adam_step(whole, g, config)
            adam_step(part, g, config)
    part.rates.use("quat").copy_(torch.linspace(0, 2, 12))
    whole.rates.use("quat").copy_(torch.linspace(0, 2, 12))
    seen = torch.tensor([0, 1, 4, 5, 6])
    boxes = Mock(Boxes)
    for _ in range(missed):
        g = rows(12, generator)
        hidden = [i for i in range(12) if i not in seen.tolist()]
        for column in vars(g).values():
            column[hidden] = 0.0
        adam_step(whole, g, config)
        some = MapPart(part, seen, boxes)
        take_missed_steps(some, config)
        adam_step(some, g[seen], config)
        some.write_back()
    assert not torch.equal(part.params.xyz_W, whole.params.xyz_W)
    take_missed_steps(part, config)
    for of in ("", "exp_avg.", "exp_avg_sq."):
        for name, column in vars(part.columns.parameters(of)).items():
            torch.testing.assert_close(column, whole.columns[of + name], atol=1e-6, rtol=1e-4)
    before = part.params.xyz_W.clone()
    take_missed_steps(part, config)
    assert torch.equal(part.params.xyz_W, before)


def test_missed_steps_of_some_rows(generator):
    params = rows(9, generator)
    seen = torch.tensor([1, 2, 7])
    whole = copies_of(params)
    part = copies_of(params)
    for _ in range(3):
        g = rows(9, generator)
        adam_step(whole, g, window_adam())
        adam_step(part, g, window_adam())
    for _ in range(5):
        g = rows(9, generator)
        for column in vars(g).values():
            column[[i for i in range(9) if i not in seen.tolist()]] = 0.0
        adam_step(whole, g, window_adam())
        seen_part = MapPart(part, seen)
        adam_step(seen_part, g[seen], window_adam())
        seen_part.write_back()
    take_missed_steps(part, window_adam())
    for name in PARAMETERS:
        torch.testing.assert_close(
            getattr(part.params, name),
            getattr(whole.params, name),
            atol=1e-6,
            rtol=1e-5,
        )


def test_an_optimiser_that_loses_values_is_refused(generator):
    def explodes(param, gradient, m, v, ages, *, lr):
        param[2:4, :1] = torch.inf

    model = map_of(generator)
    model.params.xyz_W[2, 0] = torch.nan  # lost before
    with pytest.raises(
        ValueError, match="the optimiser made 1 values of xyz_W NaN or infinite; try smaller"
    ):
        adam_step(model, gradients(model.params, generator), OptimConfig(), explodes)


def test_an_optimiser_from_outside_is_told_rates_and_ages(generator):
    """Of a map, and of a window, whose rows are all as old as the window; a rate of 0 leaves a
    group alone."""
    told = {}

    def notes(param, gradient, m, v, ages, *, lr):
        told[tuple(param.shape)] = (
            ages.tolist(),
            lr if isinstance(lr, float) else lr[:, 0].tolist(),
        )

    model = map_of(generator, 3)
    model.clock.advance(4)
    model.append(
        Seeds.isotropic(
            torch.zeros(1, 3),
            torch.zeros(1, 3),
            torch.ones(1),
        )
    )
    config = OptimConfig(lr_xyz=0.1, lr_sh_dc=0.2, lr_sh_rest=0.3, lr_opacity_logit=0.4)
    adam_step(model, gradients(model.params, generator), config, notes)
    assert told[4, 4, 3] == ([5, 5, 5, 1], pytest.approx([0.2, 0.3, 0.3, 0.3]))
    assert told[4,] == ([5, 5, 5, 1], 0.4)
    assert model.clock.count == 5
    assert model.clock.last.tolist() == [5] * 4
    told.clear()
    window = copies_of(rows(2, generator))
    for _ in range(3):
        adam_step(window, rows(2, generator), window_adam(quat=0.0), notes)
    assert told.keys() == {(2, 3), (2, 9, 3)}
    assert told[2, 9, 3] == ([3, 3], pytest.approx([RATES["sh_dc"]] + [RATES["sh_rest"]] * 8))


def test_a_part_knows_whether_its_map_has_changed(generator):
    model = map_of(generator)
    part = MapPart(model, torch.tensor([0, 4]), Mock(Boxes))
    assert part.is_current
    adam_step(part, gradients(part.params, generator), OptimConfig())
    part.write_back()
    assert part.is_current
    assert model.clock.count == part.clock.count == 1
    assert model.clock.last.tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 0]
    model.params.xyz_W.add_(1.0)
    assert not part.is_current


@pytest.mark.parametrize(
    "still", [("xyz_W",), ("xyz_W", "log_scale", "quat"), ("sh_dc", "sh_rest")]
)
def test_groups_at_rate_zero_are_left_alone(still, generator):
    before = rows(4, generator)
    model = copies_of(before)
    for _ in range(5):
        adam_step(model, rows(4, generator), window_adam(**dict.fromkeys(still, 0.0)))
    unmoved = {
        name
        for name in PARAMETERS
        if torch.equal(getattr(model.params, name), getattr(before, name))
    }
    expected = (
        set(still) & set(PARAMETERS) | {"opacity_logit"} | ({"sh"} if "sh_dc" in still else set())
    )
    assert unmoved == expected


def test_no_gradient_moves_nothing(generator):
    before = rows(3, generator)
    zero = GaussianParams(**{name: torch.zeros_like(value) for name, value in vars(before).items()})
    model = copies_of(before)
    for _ in range(3):
        adam_step(model, zero, window_adam())
    for name in PARAMETERS:
        assert torch.equal(getattr(model.params, name), getattr(before, name))
