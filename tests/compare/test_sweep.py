"""Sweeps: all combinations, checked before anything runs, and the papers' tables beside their numbers."""

import pytest

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare import RunResult, outputs
from gsfusion_nb.compare.grid import parse_axis
from gsfusion_nb.compare.paper_sweeps import PAPER_SWEEPS, beside_paper
from gsfusion_nb.compare.sweep import SweepOptions, sweep_specs

FAST = (
    "data.hold_out_every=4", "data.hold_out_offset=2", "sh_degree=0", "optim.keyframe_iterations=1",
    "optim.global_iterations=1", "seeding.quadtree_contrast=std", "tsdf.voxel_size_m=0.08",
)  # fmt: skip


def test_values_of_an_axis():
    assert parse_axis("tsdf.voxel-size-m=0.01,0.02") == ("tsdf.voxel_size_m", [0.01, 0.02])
    assert parse_axis("seeding.one-per-voxel=true, False") == ("seeding.one_per_voxel", [True, False])
    assert parse_axis("seeding.rule=gsfusion,uniform") == ("seeding.rule", ["gsfusion", "uniform"])
    for bad in ("tsdf.voxel-size-m", "=1", "a=", "a=1,1"):
        with pytest.raises(ValueError, match="expected values"):
            parse_axis(bad)


def test_all_combinations_and_seeds(scene, tmp_path):
    rule = tmp_path / "mine.py"
    rule.write_text("def mine(ctx, *, fraction=0.5):\n    return ctx.seeds_at(ctx.pixels(), 1.0)\n")
    grid = (f"seeding.rule=uniform,{rule}:mine", "tsdf.voxel-size-m=0.04,0.08", "rule.fraction=0.1")
    specs = sweep_specs(SweepOptions(data=str(scene), grid=grid, set=FAST, seeds=2))
    assert [(s.label, s.seed) for s in specs[::2]] == [
        ("uniform, voxel_size_m 0.04, fraction 0.1", 0), ("uniform, voxel_size_m 0.08, fraction 0.1", 0),
        (f"{rule}:mine, voxel_size_m 0.04, fraction 0.1", 0), (f"{rule}:mine, voxel_size_m 0.08, fraction 0.1", 0),
    ]  # fmt: skip
    assert [s.seed for s in specs[:2]] == [0, 1]
    assert specs[-1].config().tsdf.voxel_size_m == 0.08
    assert specs[-1].rule_source == rule.read_text()
    assert specs[0].budget.steps == "own"


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"grid": ("tsdf.voxel-sise-m=0.01",)}, ValueError, "voxel_sise_m"),
        ({"grid": ("tsdf.near-m=0.4,7",)}, ValueError, "below far_m"),
        ({"grid": ("rule.fraction=0.1",)}, TypeError, "has no options"),
        ({"grid": ("seeding.rule=unifrom",)}, KeyError, "no seeding rule 'unifrom'"),
        ({"grid": ("sh_degree=0", "sh-degree=1")}, ValueError, "each setting once"),
        ({}, ValueError, "either --grid"),
        ({"table": "table-ix"}, KeyError, "no table 'table-ix'; known: rtg-fig-6"),
        ({"grid": ("sh_degree=0",), "data": "nowhere"}, Exception, "is not a folder"),
        ({"grid": ("sh_degree=0",), "seeds": 0}, ValueError, "seeds"),
    ],
)
def test_mistakes_are_refused_before_anything_runs(scene, changes, error, message):
    with pytest.raises(error, match=message):
        sweep_specs(SweepOptions(**{"data": str(scene), "set": (), **changes}))


@pytest.mark.parametrize("name", PAPER_SWEEPS)
def test_the_papers_tables_are_runs_and_our_numbers_stand_beside_theirs(scene, name):
    specs = sweep_specs(SweepOptions(data=str(scene), table=name))
    assert [s.label for s in specs] == list(PAPER_SWEEPS[name].rows)
    assert len({s.key for s in specs}) == len(specs)
    metrics = {
        "psnr_held_out_db": 21.0, "psnr_mapped_db": 23.0, "ssim_held_out": 0.5, "ssim_mapped": 0.6,
        "n_gaussians": 900.0,
        "n_keyframes": 7.0, "ms_per_frame": 50.0, "model_size_mb": 0.2, "seconds_global": 3.0,
        "disc_accuracy_m": 0.02, "disc_precision": 0.9, "disc_completion_m": 0.03, "disc_completion_ratio": 0.8,
    }  # fmt: skip
    text = beside_paper(name, [RunResult(spec=s, status="done", metrics=metrics) for s in specs])
    expected = {
        "table-iv": "21.00 (25.45)", "table-v": "21.00 (25.96)", "table-vi": "21.00 (22.76)",
        "table-vii": "23.00 (28.64)", "table-viii": "23.00 (35.44)", "rtg-table-3": "96.410", "rtg-fig-6": "21.000",
    }[name]  # fmt: skip
    assert expected in text
    assert "RTG-SLAM" in beside_paper("rtg-table-3", [])


@pytest.mark.ci
def test_the_command_runs_a_sweep(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(outputs, "save_figure", lambda figure, path: None)
    out = tmp_path / "out"
    grid = ["--grid", "seeding.quadtree-threshold=0.05,0.1"]
    assert cli(["sweep", str(scene), *grid, "--set", *FAST, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "2 runs on" in text
    assert "quadtree_threshold 0.1" in (out / "table.md").read_text()
    assert cli(["sweep", str(scene), "--grid", "tsdf.voxel-size-m=0"]) == 1
    assert "tsdf.voxel_size_m must be > 0" in capsys.readouterr().err
