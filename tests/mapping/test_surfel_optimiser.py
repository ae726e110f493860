"""The gradient that is applied is that of the printed loss; what is frozen stays; transparent rows
are held."""

import copy
import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import DiscConfig, WindowConfig
from gsfusion_nb.gaussians import SurfelModel
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import surfel_optimiser
from gsfusion_nb.mapping.surfel_optimiser import WEIGHT_DEPTH, SurfelOptimiser
from gsfusion_nb.optim import TrainingView, view_step
from gsfusion_nb.render import disc_depth, render_forward
from gsfusion_nb.types import Camera, GaussianParams, Seeds

CAMERA = Camera(
    width=24,
    height=18,
    fx=22.0,
    fy=22.0,
    cx=12.0,
    cy=9.0,
)
POSE = se3.exp(torch.tensor([0.05, -0.02, 0.1, 0.1, -0.2, 0.05]))
NAMES = ("xyz_W", "log_scale", "quat", "sh")
WINDOW = WindowConfig(weight_colour=0.8, depth_behind_m=None)


@pytest.fixture(autouse=True)
def _reference():
    with use_backend("reference"):
        yield


def scene(generator, n: int = 14) -> SurfelModel:
    """Leaning discs before the camera, every fourth transparent; all moved away from their
    anchor."""

    def uniform(*shape: int, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    z = uniform(n, low=1.5, high=2.5)
    xy = uniform(n, 2, low=-0.35, high=0.35) * z[:, None]
    quat = torch.tensor([1.0, 0, 0, 0]) + 0.25 * torch.randn(n, 4, generator=generator)
    model = SurfelModel(sh_degree=1)
    model.append(
        Seeds(
            xyz_W=se3.apply(POSE, torch.cat([xy, z[:, None]], dim=1)),
            rgb=uniform(n, 3, low=0.2, high=0.8),
            scale_m=uniform(n, 3, low=0.15, high=0.4) * torch.tensor([1.0, 1.0, 0.1]),
            quat=quat,
            opacity=torch.where(torch.arange(n) % 4 == 0, 0.1, 0.99),
            tag=torch.zeros(n, dtype=torch.int32),
        )
    )
    for name in ("xyz_W", "log_scale", "quat"):
        column = getattr(model.params, name)
        column.add_(0.02 * torch.randn(column.shape, generator=generator))
    model.params.sh[:, 1:].add_(0.1 * torch.randn(n, 3, 3, generator=generator))
    return model


def view(generator) -> TrainingView:
    def uniform(*shape: int):
        return torch.rand(*shape, generator=generator)

    depth_m = 1.5 + uniform(18, 24)
    return TrainingView(
        rgb=uniform(18, 24, 3),
        depth_m=torch.where(uniform(18, 24) < 0.15, 0.0, depth_m),
        camera=CAMERA,
        T_WC=POSE,
        pixels=uniform(18, 24) < 0.8,
    )


@pytest.fixture
def gradients(monkeypatch) -> list[GaussianParams]:
    """The gradients that are handed to Adam, which does not move anything."""
    handed_over = []
    monkeypatch.setattr(
        view_step, "adam_step", lambda part, gradients, *_: handed_over.append(gradients)
    )
    return handed_over


def double(params: GaussianParams) -> GaussianParams:
    return GaussianParams(**{name: value.double() for name, value in vars(params).items()})


def when_hit(discs: DiscConfig) -> dict[str, float | None]:
    return {"max_offset": discs.max_offset, "min_cosine": discs.min_cosine}


def written_out(
    params, seen: TrainingView, window: WindowConfig, discs: DiscConfig, hit, known, held, anchor
) -> float:
    """w_c mean |C - C^| + w_d mean |D - D^| + w_reg (MSE(p) + MSE(log s) + MSE(q)) in float64,
    which pixel hits which disc, and which pixels have a depth loss, held fixed."""
    out, _ = render_forward(params, seen.camera, seen.T_WC, opaque_alpha=discs.opaque_alpha)
    if discs.depth == "disc":
        depth_m = disc_depth(params, seen.camera, seen.T_WC, hit, **when_hit(discs)).depth_m
    else:
        depth_m = out.depth_m / out.alpha
    colour = (out.rgb - seen.rgb.double())[seen.pixels].abs().mean()
    depth = (depth_m - seen.depth_m.double())[known].abs().mean()
    regulariser = sum(
        (getattr(params, name)[held] - value.double()).square().mean()
        for name, value in anchor.items()
    )
    return float(
        window.weight_colour * colour
        + WEIGHT_DEPTH * depth
        + surfel_optimiser.WEIGHT_REGULARISER * regulariser
    )


@pytest.mark.parametrize("depth", ["disc", "blended"])
def test_the_gradient_is_that_of_the_whole_printed_loss(generator, depth, gradients):
    """Central differences along random directions of every group of every trained row."""
    model = scene(generator)
    seen = view(generator)
    discs = DiscConfig(depth=depth)
    trained = torch.ones(len(model), dtype=torch.bool)
    trained[3::5] = False
    optimiser = SurfelOptimiser(model, trained, WINDOW, discs)
    loss = optimiser.step(seen).loss
    start = double(optimiser.params)
    output, _ = render_forward(optimiser.params, CAMERA, POSE, opaque_alpha=discs.opaque_alpha)
    if depth == "disc":
        rendered_m = disc_depth(
            optimiser.params, CAMERA, POSE, output.hit_index, **when_hit(discs)
        ).depth_m
    else:
        rendered_m = torch.where(output.alpha >= 0.5, output.depth_m / output.alpha, 0.0)
    known = seen.pixels & (rendered_m > 0) & (seen.depth_m > 0)
    assert known.sum() > 50
    rows = trained.nonzero().squeeze(1)
    held = model.is_transparent[rows].nonzero().squeeze(1)
    anchor = {name: value[rows][held] for name, value in model.anchor.items()}
    assert len(held) >= 2
    fixed = (seen, WINDOW, discs, output.hit_index, known, held, anchor)
    assert float(loss) == pytest.approx(
        written_out(start, *fixed) - _regulariser(start, held, anchor), rel=1e-4
    )

    n = int(trained.sum())
    h = 1e-6
    for name in NAMES:
        gradient = getattr(gradients[0], name).double()
        value = getattr(start, name)
        for _ in range(8):
            direction = torch.zeros_like(value)
            direction[:n] = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
            ends = [
                written_out(
                    dataclasses.replace(start, **{name: value + sign * h * direction}), *fixed
                )
                for sign in (1, -1)
            ]
            expected = (ends[0] - ends[1]) / (2 * h)
            found = float((gradient * direction[:n]).sum())
            scale = float((gradient * direction[:n]).norm())
            assert found == pytest.approx(expected, abs=2e-3 * scale + 1e-7), name


def _regulariser(params, held, anchor) -> float:
    terms = [
        (getattr(params, name)[held] - value.double()).square().mean()
        for name, value in anchor.items()
    ]
    return surfel_optimiser.WEIGHT_REGULARISER * float(sum(terms))


def snapshot(model: SurfelModel) -> dict[str, torch.Tensor]:
    return model.columns.snapshot()


def test_frozen_rows_do_not_move_and_the_map_changes_on_write_back_only(generator):
    model = scene(generator)
    seen = view(generator)
    trained = torch.arange(len(model)) % 2 == 0
    before = snapshot(model)
    optimiser = SurfelOptimiser(model, trained, WINDOW, DiscConfig())
    frozen = {name: value.clone() for name, value in vars(optimiser.params[optimiser.n :]).items()}
    for _ in range(5):
        optimiser.step(seen)
    for name, value in frozen.items():
        assert torch.equal(getattr(optimiser.params, name)[optimiser.n :], value), name
    assert all(
        torch.equal(a, b) for a, b in zip(snapshot(model).values(), before.values(), strict=True)
    )
    optimiser.write_back()
    after = snapshot(model)
    for name in after:
        moved = (after[name] != before[name]).reshape(len(model), -1).any(1)
        expected = trained if name in NAMES else torch.zeros_like(trained)
        assert not (moved & ~expected).any(), name
    assert (after["xyz_W"] != before["xyz_W"]).any(1)[trained].sum() > 3


def test_view_dependent_colour_learns_at_a_twentieth_of_the_base_colour(generator):
    model = scene(generator)
    optimiser = SurfelOptimiser(
        model, torch.ones(len(model), dtype=torch.bool), WINDOW, DiscConfig()
    )
    before = optimiser.trained_params.sh.clone()
    optimiser.step(view(generator))
    # Adam's first step is the rate, whatever the gradient
    moved = (optimiser.trained_params.sh - before).abs()
    assert float(moved[:, 0].max()) == pytest.approx(WINDOW.lr_sh_dc, rel=1e-3)
    assert float(moved[:, 1:].max()) == pytest.approx(WINDOW.lr_sh_dc / 20, rel=1e-2)


@pytest.mark.parametrize("weight", [0.0, 1000.0])
def test_transparent_rows_are_held_by_the_regulariser(generator, weight, monkeypatch):
    model = scene(generator)
    seen = view(generator)
    monkeypatch.setattr(surfel_optimiser, "WEIGHT_REGULARISER", weight)
    optimiser = SurfelOptimiser(
        model, torch.ones(len(model), dtype=torch.bool), WINDOW, DiscConfig()
    )
    clear = model.is_transparent
    for _ in range(60):
        optimiser.step(seen)
    away = (optimiser.trained_params.xyz_W - model.anchor["xyz_W"]).norm(dim=1)[clear]
    start = (model.params.xyz_W - model.anchor["xyz_W"]).norm(dim=1)[clear]
    closer = away < 0.35 * start
    assert closer.all() if weight else not closer.all()


def test_anchors_of_this_window_instead_of_birth(generator):
    model = scene(generator)
    seen = view(generator)
    window = dataclasses.replace(WINDOW, anchor="window")
    optimiser = SurfelOptimiser(
        model, torch.ones(len(model), dtype=torch.bool), window, DiscConfig()
    )
    clear = model.is_transparent
    for _ in range(30):
        optimiser.step(seen)
    moved = (optimiser.trained_params.xyz_W - model.params.xyz_W).norm(dim=1)
    assert moved[clear].max() < 3e-3 < moved[~clear].max()


def test_state_round_trip(generator):
    model = scene(generator)
    views = [view(generator) for _ in range(8)]
    all_rows = torch.ones(len(model), dtype=torch.bool)
    whole, stopped = (
        SurfelOptimiser(copy.deepcopy(model), all_rows, WINDOW, DiscConfig()) for _ in range(2)
    )
    for seen in views[:4]:
        whole.step(seen)
        stopped.step(seen)
    state = stopped.state_dict()
    stopped.write_back()
    resumed = SurfelOptimiser(copy.deepcopy(stopped._model), all_rows, WINDOW, DiscConfig())
    stopped.step(views[0])  # what was saved stays as it was
    resumed.load_state_dict(state)
    for seen in views[4:]:
        whole.step(seen)
        resumed.step(seen)
    for name, column in vars(whole.params).items():
        assert torch.equal(column, getattr(resumed.params, name)), name
    assert resumed.copies.clock.count == 8
