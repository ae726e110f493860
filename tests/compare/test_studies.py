"""Sweeps and studies: all variants, checked before anything runs, and the papers' tables beside
their numbers."""

import csv

import pytest

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare import RunResult
from gsfusion_nb.compare.recording_specs import ran_under
from gsfusion_nb.compare.studies import (
    STUDIES,
    PaperComparison,
    StudyOptions,
    beside_paper,
    study_specs,
)
from gsfusion_nb.compare.sweep import SweepOptions, parse_axis, sweep_specs
from gsfusion_nb.config import gsfusion, to_dict

FAST = (
    "data.hold_out_every=4",
    "data.hold_out_offset=2",
    "sh_degree=0",
    "optim.keyframe_iterations=1",
    "optim.global_iterations=1",
    "seeding.quadtree_contrast=std",
    "tsdf.voxel_size_m=0.08",
)


def test_values_of_an_axis():
    assert parse_axis("tsdf.voxel-size-m=0.01,0.02") == ("tsdf.voxel_size_m", [0.01, 0.02])
    assert parse_axis("seeding.one-per-voxel=true, False") == (
        "seeding.one_per_voxel",
        [True, False],
    )
    assert parse_axis("seeding.rule=gsfusion,uniform") == ("seeding.rule", ["gsfusion", "uniform"])
    for bad in ("tsdf.voxel-size-m", "=1", "a=", "a=1,1"):
        with pytest.raises(ValueError, match="expected values"):
            parse_axis(bad)


def test_all_combinations_and_seeds(scene, tmp_path):
    rule = tmp_path / "mine.py"
    rule.write_text("def mine(ctx, *, fraction=0.5):\n    return ctx.seeds_at(ctx.pixels(), 1.0)\n")
    grid = (f"seeding.rule=uniform,{rule}:mine", "tsdf.voxel-size-m=0.04,0.08", "rule.fraction=0.1")
    specs = sweep_specs(
        SweepOptions(
            data=str(scene),
            grid=grid,
            set=FAST,
            seeds=2,
        )
    )
    assert [(s.label, s.seed) for s in specs[::2]] == [
        ("uniform, voxel_size_m 0.04, fraction 0.1", 0),
        ("uniform, voxel_size_m 0.08, fraction 0.1", 0),
        (f"{rule}:mine, voxel_size_m 0.04, fraction 0.1", 0),
        (f"{rule}:mine, voxel_size_m 0.08, fraction 0.1", 0),
    ]
    assert [s.seed for s in specs[:2]] == [0, 1]
    assert specs[-1].config().tsdf.voxel_size_m == 0.08
    assert specs[-1].rule_source == rule.read_text()
    assert specs[0].budget.steps == "own"


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"grid": ("tsdf.voxel-sise-m=0.01",)}, ValueError, "voxel_sise_m"),
        ({"grid": ("tsdf.near-m=0.4,7",)}, ValueError, "far_m"),
        ({"grid": ("rule.fraction=0.1",)}, TypeError, "fraction"),
        ({"grid": ("seeding.rule=unifrom",)}, KeyError, "unifrom"),
        ({"grid": ("sh_degree=0", "sh-degree=1")}, ValueError, "sh_degree"),
        ({}, ValueError, "--grid"),
        ({"grid": ("sh_degree=0",), "data": "nowhere"}, Exception, "nowhere"),
        ({"grid": ("sh_degree=0",), "seeds": 0}, ValueError, "seeds"),
    ],
)
def test_mistakes_are_refused_before_anything_runs(scene, changes, error, name):
    with pytest.raises(error, match=name):
        sweep_specs(SweepOptions(**{"data": str(scene), "set": (), **changes}))


@pytest.mark.parametrize("name", STUDIES)
def test_every_variant_of_a_study_is_another_run(name):
    options = StudyOptions(name=name, set=("data.stop=9",), reader=("n_frames=20",))
    specs = study_specs(name, options, "room")
    assert [s.label for s in specs] == list(STUDIES[name].variants)
    assert len({s.key for s in specs}) == len(specs)
    for spec in specs:
        own = spec.config().seeding
        assert (spec.config().data.stop, spec.online, spec.rule) == (9, True, own.rule)
        assert own.options == spec.options


def test_only_some_variants_and_the_options_of_a_systems_own_rule():
    options = StudyOptions(name="systems", reader=("n_frames=20",))
    specs = study_specs("systems", options, "room", "GIVEN")
    assert [s.label for s in specs] == ["GSFusion, given", "RTG-SLAM, given", "GPS-SLAM, given"]
    assert specs[1].options == {"share": 0.1}
    with pytest.raises(ValueError, match="taken"):
        study_specs("systems", options, "room", "taken")
    paper = study_specs("fidelity", options, "room", "RTG-SLAM, paper")[0]
    assert paper.options == {"fidelity": "paper"}


@pytest.mark.parametrize("name", ["gsfusion-settings", "rtg-slam-settings"])
def test_each_variant_of_a_study_of_settings_changes_one(name):
    """As its label says: the group and the name of the field, or an option of the rule."""
    specs = study_specs(name, StudyOptions(name=name, reader=("n_frames=20",)), "room")
    configs = {spec.label: to_dict(spec.config()) for spec in specs}
    base = configs.pop("measured")
    for label, config in configs.items():
        group, _, field = label.split()[0].rpartition(".")
        changed = [
            (g, f)
            for g, values in config.items()
            if isinstance(values, dict)
            for f in values
            if values[f] != base[g][f] and f != "own_settings"
        ]
        assert {g for g, _ in changed} == {group or "seeding"}
        assert all(
            f.startswith(field) or (field == "share" and f == "options") for _, f in changed
        ), label


@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if study.paper])
def test_our_numbers_stand_beside_the_papers(scene, name):
    specs = study_specs(name, StudyOptions(name=name), str(scene))
    metrics = {
        "psnr_held_out_db": 21.0,
        "psnr_mapped_db": 23.0,
        "ssim_held_out": 0.5,
        "ssim_mapped": 0.6,
        "n_gaussians": 900.0,
        "n_keyframes": 7.0,
        "ms_per_frame": 50.0,
        "model_size_mb": 0.2,
        "seconds_global": 3.0,
    }
    text = beside_paper(
        STUDIES[name],
        [RunResult(spec=s, status="done", metrics=metrics) for s in specs],
    )
    expected = {
        "table-iv": "21.00 (25.45)",
        "table-v": "21.00 (25.96)",
        "table-vi": "21.00 (22.76)",
        "table-vii": "23.00 (28.64)",
        "table-viii": "23.00 (35.44)",
    }[name]
    assert expected in text
    assert "All runs have system gsfusion, preset replica, fidelity paper" in text


ONLINE = {"optim__global_iterations": 0}
PAPERS_CHANGES = {
    "table-iv": (
        "scannetpp",
        {"1 cm": {"tsdf__voxel_size_m": 0.01}, "5 cm": {"tsdf__voxel_size_m": 0.05}},
    ),
    "table-v": (
        "scannetpp",
        {text: {"seeding__quadtree_threshold": float(text)} for text in ("0.01", "0.1")},
    ),
    "table-vi": ("scannetpp", {str(n): {"optim__global_iterations": n} for n in (0, 10, 20)}),
    "table-vii": (
        "replica",
        {
            "without": {"optim__frame_iterations": 5, "optim__random_keyframe_iterations": 0}
            | ONLINE,
            "with": {"optim__frame_iterations": 3, "optim__random_keyframe_iterations": 2} | ONLINE,
        },
    ),
    "table-viii": ("replica", {str(n): {"keyframe_min_seeds": n} for n in (40, 50, 90)}),
}


@pytest.mark.parametrize("name", PAPERS_CHANGES)
def test_an_ablation_runs_with_the_papers_settings_and_changes_one(scene, name):
    """Wei & Leutenegger 2024, section IV-A.4: m 5, n 3 and 2 more on Replica; m 10, n 1 and 9 more,
    and every frame kept, on ScanNet++, whose second trajectory every 8th view stands for here."""
    preset, changes = PAPERS_CHANGES[name]
    held_out = {"data__hold_out_every": 8} if preset == "scannetpp" else {}
    specs = study_specs(name, StudyOptions(name=name), str(scene))
    assert [spec.label for spec in specs] == list(changes)
    for spec in specs:
        expected = to_dict(gsfusion(preset, "paper", **held_out, **changes[spec.label]))
        ours = to_dict(spec.config())
        for config in (ours, expected):
            config["seeding"].pop("own_settings")
        assert ours == expected


def test_what_a_study_ran_under_is_said(scene):
    options = StudyOptions(name="table-vii", set=("data.stop=9", "rule.coverage=true"))
    text = ran_under(study_specs("table-vii", options, str(scene)))
    assert text == (
        "All runs have system gsfusion, preset replica, fidelity paper, optim.global_iterations 0, "
        "data.stop 9, rule.coverage True."
    )
    text = ran_under(
        study_specs(
            "fidelity", StudyOptions(name="fidelity", reader=("n_frames=20",)), "room", "GSFusion"
        )
    )
    assert (
        text
        == "All runs have system gsfusion, preset room, data.hold_out_every 8, reader n_frames 20."
    )
    text = ran_under(
        study_specs("gsfusion-settings", StudyOptions(name="gsfusion-settings"), str(scene))
    )
    assert text == "All runs have system gsfusion, preset replica, fidelity measured."


def test_the_papers_tables_and_ours_beside_them():
    assert [study.paper.number for study in STUDIES.values() if study.paper] == [
        "IV",
        "V",
        "VI",
        "VII",
        "VIII",
    ]
    table = PaperComparison(
        "VII", {"with": {"PSNR": 20.0, "FPS": 30.0, "Gaussians": 1234, "MB": 3.0}}
    )
    head, without, with_ = table.lines()
    assert head == ["random keyframe optimisation", "PSNR", "SSIM", "FPS", "Gaussians"]
    assert without == ["without", "- (24.22)", "- (0.849)", "- (9.7)", "-"]
    assert with_ == ["with", "20.00 (28.64)", "- (0.900)", "30.0 (9.7)", "1,234"]
    thresholds = PaperComparison("VIII", {k: {"PSNR": 20.0} for k in ("10", "200", "50")})
    assert [row[0] for row in thresholds.lines()[1:]] == ["10", "40", "50", "90", "200"]
    assert "Table VII" in repr(table)
    with pytest.raises(KeyError, match="'III'"):
        PaperComparison("III", {})


@pytest.mark.ci
def test_the_commands_share_their_results(scene, tmp_path, capsys):
    grid = ["--grid", "seeding.quadtree-threshold=0.05,0.1"]
    assert cli(["sweep", str(scene), *grid, "--set", *FAST, "--out", str(tmp_path / "a")]) == 0
    assert "quadtree_threshold 0.1" in (tmp_path / "a/table.md").read_text()
    assert cli(["sweep", str(scene), "--grid", "tsdf.voxel-size-m=0"]) == 1
    assert "tsdf.voxel_size_m" in capsys.readouterr().err
    only = ["--only", "skip", "--set", *FAST, "--out"]
    for out in ("b", "c"):
        assert cli(["study", "gsfusion-settings", str(scene), *only, str(tmp_path / out)]) == 0
    rows = list(csv.DictReader((tmp_path / "c/runs.csv").read_text().splitlines()))
    assert [row["label"] for row in rows] == ["seeding.without_depth skip (both)"]
    assert float(rows[0]["metric.psnr_held_out_online_db"]) > 5
    assert float(rows[0]["metric.fps_total"]) > 0
    assert cli(["study", "weather"]) == 1
