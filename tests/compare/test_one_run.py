"""One run of the lab: equal steps for every rule, budgets that are reached, failures as rows, equal
numbers."""

import dataclasses
import inspect
import itertools
import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from gsfusion_nb.compare import Budget, RunSpec, map_scene, one_run
from gsfusion_nb.compare.map_scene import Entry, _with_pace
from gsfusion_nb.compare.one_run import run_entry, run_spec
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.run_result import MEASURED
from gsfusion_nb.compare.schedule import EQUAL_KEYFRAME_EVERY
from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.evaluation import score_view
from gsfusion_nb.runs import scored_views
from gsfusion_nb.seeding import MapRule

TWO_RULES = """
from gsfusion_nb.seeding import seeding_rule

@seeding_rule
def one(ctx, *, every=7):
    return ctx.seeds_at(ctx.pixels()[::every], 1.0)

@seeding_rule
def other(ctx, *, every=7):
    return ctx.seeds_at(ctx.pixels()[::every], 1.0)
"""


@dataclass(frozen=True, kw_only=True)
class brings_settings(MapRule):
    overrides: ClassVar[Mapping[str, Any]] = {"optim__frame_iterations": 9, "optim__lr_xyz": 5e-4}

    def seeds(self, ctx, memory):
        return ctx.seeds_at(ctx.pixels()[::9], 1.0)


def nothing(ctx):
    return ctx.seeds_at(ctx.pixels()[:0], 1.0)


def same_numbers(a, b):
    numbers = [{k: v for k, v in r.metrics.items() if k not in MEASURED} for r in (a, b)]
    assert numbers[0] == numbers[1]
    assert a.map_hash == b.map_hash


@pytest.mark.ci
def test_every_rule_takes_the_same_steps(spec):
    frugal, rich = (run_spec(spec("uniform", options={"fraction": f})) for f in (0.01, 0.9))
    classy = run_entry(Entry(spec=spec("brings_settings"), rule=brings_settings))
    own = [
        run_spec(spec("uniform", options={"fraction": f}, budget=Budget(steps="own")))
        for f in (0.01, 0.9)
    ]
    assert [r.reason for r in (frugal, rich, classy, *own)] == [""] * 5
    assert frugal.metrics["n_steps"] == rich.metrics["n_steps"] == classy.metrics["n_steps"]
    assert (
        frugal.metrics["n_keyframes"]
        == rich.metrics["n_keyframes"]
        == -(-5 // EQUAL_KEYFRAME_EVERY)
    )
    assert classy.notes == [
        "the rule's own optim.frame_iterations = 9 is not used, but 1",
        "the rule sets optim.lr_xyz = 0.0005, in place of 0.00032",
    ]
    assert own[0].metrics["n_keyframes"] != own[1].metrics["n_keyframes"]


def test_a_rule_without_seeds_has_fewer_steps_and_says_so(spec):
    result = run_entry(Entry(spec=spec("nothing"), rule=nothing))
    assert (result.status, result.metrics["n_steps"], result.metrics["n_gaussians"]) == (
        "done",
        2,
        0,
    )
    assert result.notes == [
        "after 5 of 5 frames the map was empty, so no gradient steps were taken"
    ]


def test_what_is_not_a_number_is_a_note_and_no_silence(spec, monkeypatch):
    """Of the two views that are scored first, one is broken and one perfect."""
    broken = {0: math.nan, 1: math.inf}
    views = itertools.count()

    def scored(*arguments, **options):
        row = score_view(*arguments, **options)
        return dataclasses.replace(row, psnr=broken.get(next(views), row.psnr))

    monkeypatch.setattr(scored_views, "score_view", scored)
    result = run_spec(spec("uniform"))
    assert result.metrics["n_views_nan_held_out"] == 1
    notes = [
        "1 of the views held_out have a render with a NaN: no mean of scores counts them",
        "psnr_held_out_db is inf: left out",
    ]
    assert [note for note in result.notes if "views" in note or "left out" in note] == notes
    assert all(
        note in Results(runs=[result]).tables()[0].notes[-2:][i] for i, note in enumerate(notes)
    )


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_the_first_run_of_a_process_maps(spec, system, monkeypatch):
    monkeypatch.setattr(map_scene, "_warm", set())
    given = {"data": spec().data, "settings": {"data.stop": 3}, "budget": Budget(steps="own")}
    result = run_spec(RunSpec(rule=system, scene="wall", system=system, **given))
    assert (result.status, result.reason) == ("done", "")


def test_what_a_result_holds(spec, tmp_path):
    result = run_spec(spec("gsfusion"), tmp_path)
    expected = {
        "psnr_mapped_db",
        "psnr_held_out_db",
        "ssim_mapped",
        "ssim_held_out",
        "depth_l1_mapped_m",
        "depth_l1_held_out_m",
        "n_gaussians",
        "n_keyframes",
        "n_steps",
        "n_frames",
        "ms_per_frame",
        "cpu_ms_per_frame",
        "seeding_ms",
        "seconds_total",
    }
    assert expected <= set(result.metrics)
    assert set(result.pictures) == {"held_out 2", "truth 2", "held_out 6", "truth 6"}
    assert all((tmp_path / name).is_file() for name in result.pictures.values())
    assert "def gsfusion(\n" in result.rule_source
    assert "PyTorch" in result.versions


def test_it_repeats_bit_for_bit_and_equal_rules_tie(spec):
    one, other = (spec(f"two.py:{name}", rule_source=TWO_RULES) for name in ("one", "other"))
    assert one.key != other.key
    first = run_spec(one)
    second = run_spec(other)
    same_numbers(first, run_spec(one))
    same_numbers(first, second)
    assert first.rule_source == TWO_RULES


@pytest.mark.parametrize(
    ("rule", "changes", "option"),
    [
        ("uniform", {}, "fraction"),
        ("gsfusion", {}, "coarseness"),
        ("dense", {"size_option": "thin"}, "thin"),
        ("two.py:one", {"rule_source": TWO_RULES, "size_option": "every"}, "every"),
    ],
)
def test_a_number_of_gaussians_is_reached(spec, rule, changes, option):
    result = run_spec(
        spec(
            rule,
            budget=Budget(gaussians=150, tolerance=0.05),
            **changes,
        )
    )
    assert (result.status, result.reason) == ("done", "")
    assert result.metrics["n_gaussians"] == pytest.approx(150, rel=0.05)
    assert result.tuned["option"] == option
    assert result.tuned["error_percent"] == pytest.approx(
        100 * abs(result.metrics["n_gaussians"] / 150 - 1)
    )
    assert result.spec.label == rule.rpartition(":")[2]


def faulty(ctx, *, n=3):
    raise IndexError("7 is out of range")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"rule": "dense", "budget": Budget(gaussians=100)}, "dense has no size option"),
        (
            {"rule": "dense", "size_option": "fraction", "budget": Budget(gaussians=100)},
            "no option 'fraction' to tune",
        ),
        (
            {"rule": "uniform", "budget": Budget(gaussians=10**6)},
            "uniform does not reach 1,000,000 Gaussians",
        ),
        ({"rule": "uniform", "options": {"fration": 0.1}}, "has no options"),
        ({"rule": "nonsense"}, "no seeding rule 'nonsense'"),
        ({"rule": "a.py:b", "rule_source": "x = 1 +"}, "a.py, line 1: SyntaxError"),
        ({"data": "/nowhere", "data_hash": "x"}, "/nowhere is not a folder"),
    ],
)
def test_a_run_that_fails_is_a_row_with_its_reason(spec, changes, reason):
    made = spec(changes.pop("rule", "uniform"))
    result = run_spec(type(made)(**{**vars(made), "label": "", **changes}))
    assert result.status == "failed"
    assert reason in result.reason
    assert not result.metrics


def test_a_rule_that_raises_fails_its_run(spec):
    result = run_entry(
        Entry(
            spec=spec(
                "faulty",
            ),
            rule=faulty,
        )
    )
    assert (result.status, result.reason) == ("failed", "IndexError: 7 is out of range")


@pytest.mark.parametrize(("n_frames", "asked"), [(40, "5 of 5"), (4000, "1 of 5")])
def test_intervals_of_rules_are_those_of_a_recording(n_frames, asked):
    """The room is a walk of 49 s; five of 40 frames are 38 frames of a camera apart, five of 4,000
    a third of one."""
    settings = {
        "data.width": 32,
        "data.height": 24,
        "data.stop": 6,
        "tsdf.voxel_size_m": 0.1,
        "sh_degree": 0,
        "optim.global_iterations": 0,
    }
    run = RunSpec(
        rule="cg_slam", reader={"n_frames": n_frames, "width": 64, "height": 48}, settings=settings
    )
    assert any(
        f"asked every 30 frames of the recording, here in {asked}" in note
        for note in run_spec(run).notes
    )


FIVE = "asked every 5 frames of the recording, here in 5 of 5 mapped frames"


@pytest.mark.parametrize(
    ("steps", "notes"),
    [("equal", [FIVE]), ("own", [])],
)
def test_in_the_equal_schedule_a_rule_for_keyframes_has_those_of_its_release(spec, steps, notes):
    run = spec("gs_slam", {"seeding.source_stride": 6}, budget=Budget(steps=steps))
    result = run_spec(run)
    assert result.status == "done"
    assert [n for n in result.notes if n.startswith("asked")] == notes
    assert result.metrics["n_keyframes"] == (2 if steps == "equal" else 5)


@pytest.mark.parametrize("poses", ["given", "tracked"])
@pytest.mark.parametrize(
    ("stride", "given", "used"),
    [(1, 0, 6), (2, 0, 12), (1, 7, 7)],
)
def test_the_rooms_frames_are_as_far_apart_as_they_were_seen(stride, given, used, poses):
    """240 frames of a walk of 49 s: six frames of a camera with 30 Hz from one to the next; a
    setting stays."""
    settings = {"data__stride": stride, "seeding__source_stride": given}
    config = gsfusion("room", tracking__poses=poses, **settings)
    sequence = open_sequence("room", n_frames=240, width=16, height=12, data=config.data)
    assert _with_pace(config, sequence).seeding.source_stride == used


@pytest.mark.parametrize(
    ("errors", "runs", "error"),
    [((0.5, 0.001), 7, 0.1), ((0.001,), 4, 0.1)],
)
def test_a_run_that_misses_its_size_is_tuned_once_more_with_its_own_seed(
    monkeypatch, errors, runs, error
):
    entry = Entry(
        spec=RunSpec(
            rule="uniform",
            seed=5,
            budget=Budget(gaussians=1000),
        )
    )
    seeds = []
    left = iter([*errors, errors[-1]])

    def tuned_again(entry, on_step):
        seeds.append(entry.spec.seed)
        return {"n_runs": 3}

    monkeypatch.setattr(one_run, "tune", tuned_again)
    monkeypatch.setattr(one_run, "with_tuned", lambda entry, tuned: entry)
    monkeypatch.setattr(one_run, "_map", lambda entry, tuned, on_step: tuned)
    monkeypatch.setattr(one_run, "_error", lambda mapped, budget: next(left))
    monkeypatch.setattr(one_run, "_result", lambda entry, mapped, numbers, folder: numbers)
    numbers: Any = inspect.unwrap(one_run.run_entry)(entry, None, {"n_runs": 4})
    assert numbers == {"n_runs": runs, "error_percent": pytest.approx(error)}
    assert seeds == [5] * (len(errors) - 1)


def test_a_row_says_how_many_frames_are_not_in_its_map(scene, tmp_path):
    """Frames that cannot be read, or are not located, are few steps and a poor score for no reason
    of the rule."""
    wall = shutil.copytree(scene, tmp_path / "wall")
    (wall / "rgb/000002.png").write_bytes(b"no image")
    settings = {"tsdf.voxel_size_m": 0.08, "sh_degree": 0, "optim.global_iterations": 0}
    result = run_spec(
        RunSpec(rule="uniform", data=str(wall), scene="wall", settings=settings, seed=0)
    )
    assert result.status == "done", result.reason
    (note,) = (note for note in result.notes if "not in the map" in note)
    n = len(open_sequence(wall).mapping)
    assert note.startswith(f"1 of {n} frames are not in the map, the first because ")
    assert "000002.png" in note
