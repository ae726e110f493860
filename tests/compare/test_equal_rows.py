"""Rows that made the same map, and scenes that share frames, are named by each command and in each
file."""

import csv
import json

import pytest

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare import RunSpec, studies
from gsfusion_nb.compare.benchmark import report
from gsfusion_nb.compare.data_sets import DATA_SETS
from gsfusion_nb.compare.equal_maps import equal_maps, unknown_maps
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.run_result import RunResult
from gsfusion_nb.compare.runs_csv import as_csv
from gsfusion_nb.compare.studies import Study

QUICK = [
    "tsdf.voxel_size_m=0.08",
    "sh_degree=0",
    "seeding.rule=uniform",
    "data.hold_out_every=4",
    "data.hold_out_offset=2",
    "optim.global_iterations=1",
    "optim.keyframe_iterations=1",
    "optim.frame_iterations=1",
    "optim.random_keyframe_iterations=0",
]
UNUSED = "seeding.quadtree_threshold"
"""A setting of a rule that is not in use."""
_QUICK_VALUES = [line.split("=") for line in QUICK if "rule=" not in line]
_SETTINGS = "\n".join(f'"{name}" = {value}' for name, value in _QUICK_VALUES)
LAB = f"""
[settings]
{_SETTINGS}
[[scenes]]
data = "SCENE"
label = "wall"
[[scenes]]
data = "SCENE"
label = "wall again"
[[rules]]
rule = "uniform"
label = "0.05"
settings = {{ "{UNUSED}" = 0.05 }}
[[rules]]
rule = "uniform"
label = "0.06"
settings = {{ "{UNUSED}" = 0.06 }}
"""
EFFECT = "made the same map on {} (seed 0): what differs between them had no effect"


def files_of(folder) -> tuple[str, str, dict, list[dict]]:
    """Text of the table and of the page, and what programs read."""
    rows = list(csv.DictReader((folder / "runs.csv").read_text().splitlines()))
    table = json.loads((folder / "table.json").read_text())
    return (folder / "table.md").read_text(), (folder / "page.html").read_text(), table, rows


@pytest.mark.parametrize("command", ["sweep", "study"])
def test_a_setting_without_effect_is_named(command, scene, tmp_path, capsys, monkeypatch):
    names = ["quadtree_threshold 0.05", "quadtree_threshold 0.06"]
    what = ["sweep", str(scene), "--grid", f"{UNUSED}=0.05,0.06"]
    if command == "study":
        names = ["coarse", "fine"]
        made = Study(
            question="Cells?",
            variants={"coarse": {UNUSED: 0.05}, "fine": {UNUSED: 0.06}},
        )
        monkeypatch.setitem(studies.STUDIES, "cells", made)
        what = ["study", "cells", str(scene)]
    assert cli([*what, "--out", str(tmp_path / "out"), "--set", *QUICK]) == 0
    sentence = f"{names[0]} and {names[1]} {EFFECT.format(scene.name)}"
    text, page, table, rows = files_of(tmp_path / "out")
    assert sentence in capsys.readouterr().out.replace("\\_", "_")
    assert sentence in text.replace("\\_", "_")
    assert sentence in page
    (budget,) = table["budgets"]
    assert budget["equal_maps"] == [{"rules": names, "places": [{"scene": scene.name, "seed": 0}]}]
    assert [row["same_map_as"] for row in rows] == names[::-1]


def test_the_lab_names_equal_maps_and_scenes_that_share_frames(scene, tmp_path, capsys):
    (tmp_path / "table.toml").write_text(LAB.replace("SCENE", str(scene)))
    assert cli(["lab", str(tmp_path / "table.toml"), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    text, page, table, rows = files_of(tmp_path / "out")
    shared = "wall and wall again share frames, so they count as one scene in means and tests"
    same = (
        "0.05 and 0.06 made the same map on wall (seed 0); wall again (seed 0): what differs "
        "between them"
    )
    for place in (said, text, page):
        assert shared in place
        assert same in place
    (budget,) = table["budgets"]
    assert (budget["scenes"], budget["units"]) == (["wall", "wall again"], [["wall", "wall again"]])
    assert {row["metrics"]["psnr_held_out_db"]["n"] for row in budget["rows"]} == {1}
    assert {row["unit"] for row in rows} == {"wall + wall again"}


def test_a_table_of_a_benchmark_and_one_of_a_notebook_name_them(made_result):
    made = [
        made_result(label, scene="office0", map_hash="abc") for label in ("GSFusion", "RTG-SLAM")
    ]
    sentence = f"GSFusion and RTG-SLAM {EFFECT.format('office0')}"
    assert f"- {sentence}" in report(DATA_SETS["replica"], made, {}).splitlines()
    assert f"<div>{sentence}</div>" in Results(runs=made)._repr_html_()


def test_a_benchmark_counts_scenes_that_share_frames_once(made_result):
    psnr = {"office0": 20.0, "office0 again": 21.0, "room0": 40.5}
    frames = {"office0": ["f1", "f2"], "office0 again": ["f2", "f3"], "room0": ["f9"]}
    made = [
        made_result(
            "A",
            scene=s,
            psnr=p,
            map_hash=s,
            frames=frames[s],
        )
        for s, p in psnr.items()
    ]
    text = report(DATA_SETS["replica"], made, {})
    assert "| **A, here** | 30.50 |" in text
    assert (
        "office0 and office0 again share frames, so they count as one scene in means and tests"
        in text
    )


@pytest.fixture
def made_result():
    """A function that makes a result with this hash of its map."""

    def make(
        label,
        *,
        map_hash,
        scene="room",
        seed=0,
        psnr=20.0,
        **more,
    ):
        spec = RunSpec(rule="uniform", label=label, scene=scene, data="room", seed=seed)
        metrics = {
            "psnr_held_out_db": psnr,
            "psnr_mapped_db": psnr,
            "n_gaussians": 9.0,
            "n_steps": 9.0,
            "n_frames": 4,
        }
        return RunResult(spec=spec, status="done", metrics=metrics, map_hash=map_hash, **more)

    return make


def test_rows_are_joined_over_scenes_and_seeds(made_result):
    places = [("x", 0), ("x", 1), ("y", 0)]
    runs = [
        made_result(label, map_hash=f"{s}{k}", scene=s, seed=k)
        for s, k in places
        for label in ("a", "b", "c")
    ]
    runs[-1] = made_result("c", map_hash="other", scene="y")
    assert [str(e).partition(":")[0] for e in equal_maps(runs)] == [
        "a, b and c made the same map on x (seed 0, 1)",
        "a and b made the same map on y (seed 0)",
    ]
    assert Results(runs=runs).tables()[1].notes.count(str(equal_maps(runs[:6])[0])) == 1


def test_a_row_names_the_equal_rows_of_its_own_scene_and_seed(made_result):
    runs = [
        made_result(label, map_hash=map_hash, scene=scene)
        for scene, label, map_hash in (
            ("x", "a", "1"),
            ("x", "b", "1"),
            ("x", "c", "2"),
            ("y", "a", "3"),
            ("y", "b", "4"),
            ("y", "c", "4"),
        )
    ]
    rows = csv.DictReader(as_csv(runs).splitlines())
    assert [row["same_map_as"] for row in rows] == ["b", "a", "", "", "c", "b"]


def test_a_map_without_a_hash_is_not_known_to_be_equal(made_result):
    runs = [
        made_result("a", map_hash=""),
        made_result("b", map_hash=""),
        made_result("c", map_hash="1"),
    ]
    assert equal_maps(runs) == []
    (sentence,) = unknown_maps(runs)
    assert sentence == "whether the maps of a, b equal others is not known: no hash of them"
    assert sentence in Results(runs=runs).tables()[0].notes
