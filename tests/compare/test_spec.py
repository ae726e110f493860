"""What a run of the lab is: plain values to JSON and back, and a key of everything that decides its
result."""

import json

import pytest
import torch

from gsfusion_nb.compare import Budget, RunResult, RunSpec, entries_of
from gsfusion_nb.data import open_sequence
from gsfusion_nb.seeding import seeding_rule

SPEC = RunSpec(
    rule="uniform",
    options={"fraction": 0.1},
    data="room",
    reader={"n_frames": 60},
    seed=2,
    budget=Budget(gaussians=4000),
    settings={"tsdf.voxel_size_m": 0.02, "data.width": 160, "data.height": 120},
    size_option="fraction",
    size_range=(0.001, 1.0),
)


def changed(**changes):
    return RunSpec.from_json(SPEC.to_json() | changes)


def test_a_run_is_plain_values_and_comes_back():
    assert RunSpec.from_json(json.loads(json.dumps(SPEC.to_json()))) == SPEC
    assert SPEC.label == "uniform fraction=0.1"
    assert str(SPEC.budget) == "4,000 Gaussians, equal steps"
    with pytest.raises(TypeError, match="sede"):
        changed(sede=3)


def test_the_settings_of_a_run_are_the_preset_with_its_changes():
    config = SPEC.config()
    assert config.seeding.rule == "uniform"
    assert config.seeding.options == {"fraction": 0.1}
    assert (config.seed, config.data.width, config.tsdf.voxel_size_m) == (2, 160, 0.02)
    with pytest.raises(ValueError, match="voxel_sise_m"):
        changed(settings={"tsdf.voxel_sise_m": 0.02}).config()


def test_the_key_follows_from_the_content_and_not_from_names():
    same = [SPEC, changed(label="mine"), changed(scene="a room"), changed(preset="room")]
    others = [
        changed(seed=1),
        changed(rule="dense", options={}),
        changed(options={"fraction": 0.2}),
        changed(budget={"gaussians": 4001}),
        changed(reader={"n_frames": 61}),
        changed(rule_source="def uniform(ctx): ..."),
        changed(settings={"tsdf.voxel_size_m": 0.05}),
    ]
    assert len({spec.key for spec in same}) == 1
    assert len({spec.key for spec in [SPEC, *others]}) == 1 + len(others)


def test_an_edited_rule_of_a_notebook_has_another_key():
    def mine(ctx):
        return ctx.cells()

    first = (seeding_rule(mine), RunSpec(rule="mine").key)[1]

    def edited(ctx):
        return ctx.cells()[::2]

    edited.__name__ = "mine"
    seeding_rule(edited)
    assert RunSpec(rule="mine").key != first


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gaussians": 0}, "budget.gaussians"),
        ({"tolerance": 0.9}, "budget.tolerance"),
    ],
)
def test_a_budget_that_means_nothing_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        RunSpec(rule="uniform", budget=Budget(**values))


def test_a_result_is_written_and_read_back(tmp_path):
    result = RunResult(
        spec=SPEC,
        status="done",
        metrics={"psnr_held_out_db": 21.5, "ssim_held_out": float("nan")},
        tuned={"option": "fraction", "value": 0.03},
        map_hash="ab",
    )
    result.save(tmp_path / "a.json")
    back = RunResult.load(tmp_path / "a.json")
    assert back.metrics == {"psnr_held_out_db": 21.5}
    assert (back.spec, back.tuned, back.key) == (SPEC, result.tuned, SPEC.key)
    (tmp_path / "a.json").write_text('{"spec": {}}')
    with pytest.raises(ValueError, match="is not the result of a run"):
        RunResult.load(tmp_path / "a.json")


def test_extra_images_are_part_of_the_key(scene):
    def key(value):
        sequence = open_sequence(
            scene, extra=lambda frame: {"label": torch.full_like(frame.depth_m, value)}
        )
        return entries_of(["uniform"], [sequence])[0].spec.key

    assert key(1.0) == key(1.0) != key(0.0)
