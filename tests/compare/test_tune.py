"""Every rule has an option that decides its number of Gaussians; the search for its value takes few
runs."""

from dataclasses import dataclass

import pytest
import torch

from gsfusion_nb.compare import Budget, Entrant, RunSpec, size_options, tune
from gsfusion_nb.compare.map_scene import map_scene
from gsfusion_nb.compare.rule_variants import _draw, thinned
from gsfusion_nb.compare.search import NotReachedError, nearest, search
from gsfusion_nb.compare.size_options import SIZE_OPTIONS, THIN, size_option, start_value, with_size
from gsfusion_nb.seeding import MapRule, SeedContext, apply_rule, is_built_in, registered
from gsfusion_nb.types import Camera, Frame, Seeds

WITHOUT = {"dense"}


def test_every_rule_of_the_package_is_covered():
    assert {name for name, rule in registered().items() if is_built_in(rule)} == set(
        SIZE_OPTIONS
    ) | WITHOUT


@pytest.mark.parametrize("name", SIZE_OPTIONS)
def test_the_option_exists_and_its_usual_value_is_in_range(name):
    spec = RunSpec(rule=name)
    rule = registered()[name]
    option = size_option(spec, rule)
    start = start_value(spec, rule, option)
    assert option.low <= start <= option.high
    smaller = with_size(
        spec,
        option,
        start / 2 if isinstance(start, float) else max(start // 2, 1),
    )
    assert start_value(smaller, rule, option) < start
    assert smaller.label == spec.label
    smaller.config()


RANGES = [
    ("share", 0.25, (1e-5, 1.0)),
    ("share", 1.0, (1e-5, 1.0)),
    ("width_px", 1.5, (1.5e-4, 1.5e4)),
    ("seeding.quadtree_threshold", 0.5, (5e-5, 5e3)),
    ("every", 3, (1, 3000)),
    (THIN, 0.5, (1e-5, 1.0)),
]


@pytest.mark.parametrize(("name", "start", "expected"), RANGES)
def test_the_range_of_an_option_follows_from_its_usual_value(monkeypatch, name, start, expected):
    """A share is at most 1; a number with a unit may be 10,000 times larger or smaller."""
    monkeypatch.setattr(size_options, "start_value", lambda *_: start)
    assert size_options._usual_range(
        RunSpec(rule="uniform"), registered()["uniform"], name
    ) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("n", "share", "kept"),
    [(11, 0.25, 3), (10, 0.24, 2), (7, 0.0, 0), (7, 1.0, 7)],
)
def test_a_share_is_rounded_to_the_nearest_number(n, share, kept):
    seeds = Seeds.isotropic(
        torch.arange(3.0 * n).view(n, 3),
        torch.full((n, 3), 0.5),
        torch.ones(n),
        opacity=0.5,
    )
    some = _draw(seeds, share, torch.Generator().manual_seed(0))
    assert len(some) == kept
    assert some.xyz_W[:, 0].tolist() == sorted(set(some.xyz_W[:, 0].tolist()))


@pytest.mark.parametrize("name", ["edge_discs", "edge_strokes"])
def test_a_share_of_a_function_and_of_a_class_is_drawn(name):
    camera = Camera(
        width=64,
        height=48,
        fx=50.0,
        fy=50.0,
        cx=32.0,
        cy=24.0,
    )
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.rand(48, 64, 3),
        depth_m=torch.full((48, 64), 2.0),
        camera=camera,
        T_WC=torch.eye(4),
    )
    some = thinned(registered()[name], 0.25)
    every, quarter = (
        len(apply_rule(r, SeedContext(frame), {"coverage": False})) for r in (name, some)
    )
    assert quarter == round(every / 4) > 10


def reads_nothing(ctx, *, spacing_px: int = 8):
    return ctx.seeds_at(ctx.pixels()[::spacing_px], 2.0)


def reads_the_map(ctx, *, spacing_px: int = 8):
    seeds = ctx.seeds_at(ctx.pixels()[::spacing_px], 2.0)
    return seeds[~ctx.occupied(seeds.xyz_W, 0.01)]


@dataclass(frozen=True, kw_only=True)
class edits_the_map(MapRule):
    spacing_px: int = 8

    def seeds(self, ctx, memory):
        return ctx.seeds_at(ctx.pixels()[:: self.spacing_px], 2.0)

    def after_step(self, ctx, stats, memory):
        return None


@pytest.mark.parametrize(
    ("rule", "with_steps"),
    [(reads_nothing, False), (reads_the_map, True), (edits_the_map, True)],
)
def test_only_rules_that_use_the_map_are_tuned_with_gradient_steps(rule, with_steps, monkeypatch):
    steps = []

    def recorded(entry, config, **options):
        steps.append(config.optim.frame_iterations > 0)
        return map_scene(entry, config, **options)

    monkeypatch.setattr(tune, "map_scene", recorded)
    run = Entrant(rule, size_option="spacing_px").entry(
        data="room",
        reader={"n_frames": 2},
        budget=Budget(gaussians=150, tolerance=0.2),
        settings={
            "data.width": 48,
            "data.height": 36,
            "tsdf.voxel_size_m": 0.05,
            "optim.global_iterations": 0,
        },
    )
    found = tune.tune(run)
    assert not steps[0]
    assert any(steps) == with_steps
    assert found["n_runs"] == len(steps)
    assert found["n_gaussians"] == pytest.approx(150, rel=0.2)


def test_a_run_with_far_too_many_gaussians_is_given_up(monkeypatch):
    n_frames = []

    def recorded(entry, config, **options):
        n_frames.append(0)
        for report in map_scene(entry, config, **options):
            n_frames[-1] += 1
            yield report

    def ten_at_least(ctx, *, spacing_px: int = 8):
        return ctx.seeds_at(ctx.pixels()[:: min(spacing_px, 10)], 2.0)

    monkeypatch.setattr(tune, "map_scene", recorded)
    run = Entrant(ten_at_least, size_option="spacing_px").entry(
        data="room",
        reader={"n_frames": 8},
        budget=Budget(gaussians=15),
        settings={
            "data.width": 48,
            "data.height": 36,
            "tsdf.voxel_size_m": 0.05,
            "optim.global_iterations": 0,
        },
    )
    with pytest.raises(NotReachedError, match="ten_at_least does not reach 15 Gaussians"):
        tune.tune(run)
    assert len(n_frames) < 8
    assert max(n_frames) == 1  # given up in the first of seven frames


def found(
    count,
    start,
    target,
    low=1e-6,
    high=100.0,
    tolerance=0.02,
    whole=False,
):
    counts = search(
        count, target, start=start, low=low, high=high, tolerance=tolerance, whole=whole
    )
    return nearest(counts, target, tolerance), len(counts)


CURVES = {
    "proportional": lambda v: 1000 * v,
    "inverse": lambda v: 300 / v,
    "falls slowly": lambda v: 3000 * v**-0.3,
    "saturates": lambda v: 1200 * v / (1 + v),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("start", [0.01, 0.5, 20.0])
def test_the_search_finds_the_value_in_few_runs(name, start):
    value, n_runs = found(CURVES[name], start, 900.0)
    assert CURVES[name](value) == pytest.approx(900, rel=0.02)
    assert n_runs <= 10


def test_whole_numbers():
    assert found(
        lambda v: 10 * v,
        3,
        500.0,
        low=1,
        high=1000,
        whole=True,
    ) == (50, 3)
    with pytest.raises(NotReachedError, match="00"):
        found(
            lambda v: 200 * v,
            9,
            500.0,
            low=1,
            high=1000,
            whole=True,
        )


@pytest.mark.parametrize(
    ("curve", "names"),
    [
        (lambda v: min(1000 * v, 700), "700"),
        (lambda v: 0, "0"),
        (lambda v: max(5000.0, v), "5,000"),
        (lambda v: 100 if v < 0.5 else 5000 * v, "100"),
    ],
)
def test_what_cannot_be_reached_is_said_soon(curve, names):
    runs = []

    def count(v):
        runs.append(v)
        return curve(v)

    with pytest.raises(NotReachedError, match=names):
        found(count, 0.1, 900.0, high=1.0)
    assert len(runs) <= 16
