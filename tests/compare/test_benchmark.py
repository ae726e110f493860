"""Data sets by their published protocol: which scenes are found, what is run, and what the table
says."""

import re

import pytest
from box_room import Box

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare.benchmark import (
    BenchmarkOptions,
    _card,
    benchmark_specs,
    beside_papers,
    report,
    scenes_in,
)
from gsfusion_nb.compare.data_sets import COLUMNS, DATA_SETS, data_set_of
from gsfusion_nb.compare.run_result import RunResult
from gsfusion_nb.compare.spec import RunSpec

QUICK = (
    "optim.global_iterations=1",
    "sh_degree=0",
    "tsdf.voxel_size_m=0.08",
    "seeding.quadtree_contrast=std",
)


@pytest.fixture
def replica(tmp_path):
    """Two scenes, of which papers report one, and one without its last poses."""
    for name in ("room0", "mine", "office1"):
        Box().replica(tmp_path / "data" / name)
    (tmp_path / "data/office1/traj.txt").write_text("")
    return tmp_path / "data"


def test_scenes_are_found_by_their_files(replica):
    assert list(scenes_in(replica, "replica")) == ["mine", "office1", "room0"]
    assert list(scenes_in(replica.parent, "replica")) == ["data-mine", "data-office1", "data-room0"]
    assert scenes_in(replica / "room0", "replica") == {"room0": replica / "room0"}
    Box().replica(replica / "room0/earlier")  # what lies inside a scene is no other scene
    Box().replica(replica / "a/b/c/too_deep")
    assert list(scenes_in(replica, "replica")) == ["mine", "office1", "room0"]
    with pytest.raises(
        FileNotFoundError, match=r"no scene in the layout tum; expected a folder with rgb\.txt"
    ):
        scenes_in(replica, "tum")


@pytest.mark.parametrize(
    ("frames", "seeds", "words"),
    [
        ((7,), (0, 0), "7 frames mapped a scene at 64x48, poses given, .* 1 seed, on cpu, ours 1"),
        ((7, 2500), (0, 1), "7 to 2,500 frames .* 2 seeds, on cpu, ours 1"),
    ],
)
def test_a_row_says_its_frames_and_seeds(frames, seeds, words):
    own = [
        RunResult(
            spec=RunSpec(rule="uniform", seed=seed),
            status="done",
            metrics={"n_frames": float(n)},
            image_size="64x48",
            versions={"program": "ours 1"},
        )
        for n in frames
        for seed in seeds
    ]
    said = _card("ours", own, DATA_SETS["replica"], {})
    assert re.fullmatch(rf'ours: fidelity "measured" \(settings of .*\), {words}', said)
    assert (
        _card("ours", own, DATA_SETS["replica"], {"sh_degree": 0})
        == f"{said}; changed: sh_degree=0"
    )


@pytest.mark.parametrize("name", DATA_SETS)
def test_every_protocol_is_complete(name):
    asked = DATA_SETS[name]
    assert asked.scenes
    assert all(sentence.endswith(".") for sentence in asked.protocol)
    assert all(set(row["numbers"]) <= set(COLUMNS) and row["source"] for row in asked.published)
    for table in asked.tables:
        assert table["title"]
        assert all(len(values) == len(table["columns"]) for values in table["rows"].values())


def test_the_tables_of_gps_slams_paper_are_there():
    """Tables 1 to 7 of arXiv 2509.11574 v2, a number of each."""
    own = {
        name: [
            row["numbers"]
            for row in asked.published
            if "2509.11574" in row["source"] and row["system"] == "GPS-SLAM"
        ]
        for name, asked in DATA_SETS.items()
    }
    replica = own["replica"][0]
    tum = own["tum"][0]
    scannetpp = own["scannetpp"][0]
    assert [replica[c] for c in ("psnr", "ssim", "lpips", "fps", "memory")] == [
        37.24,
        0.960,
        0.103,
        252.64,
        3979,
    ]
    assert (replica["ate"], tum["ate"]) == (0.17, 3.08)
    assert (scannetpp["psnr"], scannetpp["ssim"], scannetpp["lpips"]) == (25.81, 0.872, 0.278)
    found = {
        table["title"]: table["rows"] for asked in DATA_SETS.values() for table in asked.tables
    }
    of = {
        n: next(rows for title, rows in found.items() if f"2025, Table {n})" in title)
        for n in (2, 5, 6, 7)
    }
    assert of[2]["GPS-SLAM"] == ["2.6", "2.2", "1.1", "4,000", "137,200", "41.15", "380.72"]
    assert of[5]["GPS-SLAM"] == ["0.60", "99.93", "0.61", "99.50"]
    assert of[6]["1 cm"] == ["34.09", "107.48", "0.21", "1.77", "193", "560"]
    assert of[7]["sorted"][-1] == "152.86"
    assert sum("2025, Table 1)" in title for title in found) == 2


def test_the_protocol_is_set_and_what_changes_it_is_kept(replica):
    options = BenchmarkOptions(
        name="replica", folder=str(replica), set=("data.scored_views=5",), seeds=2
    )
    specs, unread = benchmark_specs(DATA_SETS["replica"], options)
    assert [s.label for s in specs[:6:2]] == ["GSFusion", "RTG-SLAM", "GPS-SLAM"]
    assert [(s.scene, s.seed) for s in specs[:2]] == [("mine", 0), ("mine", 1)]
    assert {
        (s.config().data.hold_out_every, s.config().data.scored_views, s.preset) for s in specs
    } == {(0, 5, "replica")}
    assert len(unread) == 1
    assert "office1 cannot be read" in unread[0]
    only = BenchmarkOptions(name="replica", folder=str(replica / "office1"))
    with pytest.raises(ValueError, match="office1 cannot be read"):
        benchmark_specs(DATA_SETS["replica"], only)


def test_means_over_scenes_stand_above_the_papers_numbers(replica):
    asked = DATA_SETS["replica"]
    options = BenchmarkOptions(
        name="replica",
        folder=str(replica),
        systems=("gps_slam",),
        seeds=2,
    )
    specs, _ = benchmark_specs(asked, options)
    psnr = {
        ("mine", 0): 30.0,
        ("mine", 1): 32.0,
        ("room0", 0): 40.0,
    }  # the second seed of room0 failed
    results = [
        RunResult(
            spec=s,
            status="done",
            metrics={"psnr_mapped_db": psnr[s.scene, s.seed], "n_frames": 4},
        )
        if (s.scene, s.seed) in psnr
        else RunResult(spec=s, status="failed", reason="no memory")
        for s in specs
    ]
    text = report(asked, results, {"data.stop": 4}, ["office1 cannot be read: no poses"])
    ours, first = text.splitlines()[4:6]
    assert (
        ours
        == "| **GPS-SLAM, here** | 35.50 | – | – | – | – | – | – | 1 of the 8, 1 other scenes |"
    )
    assert first.startswith(
        "| GSFusion | 34.65 | 0.949 | 0.056 | – | 9.73 | 40.1 | – | Wei & Leutenegger 2024"
    )
    assert "| 1 cm | 34.09 | 107.48 | 0.21 | 1.77 | 193 | 560 |" in text
    for words in (
        "not here: room1, room2, office0",
        "changed: data.stop=4",
        "failed on room0: no memory",
        "no poses",
    ):
        assert words in text


def test_what_ran_stands_apart_from_what_was_published():
    own = RunResult(
        spec=RunSpec(rule="gsfusion", fidelity="paper", label="GSFusion", preset="replica"),
        status="done",
        metrics={"n_frames": 4.0},
        image_size="120x68",
    )
    text = report(DATA_SETS["replica"], [own], {})
    ran, _, published = text.partition("## The protocol of the papers")
    assert "4 frames mapped a scene at 120x68" in ran
    assert 'fidelity "paper"' in ran
    assert "2,000" not in ran
    assert "All 2,000 frames of each scene are mapped at 1200x680" in published


def test_the_table_for_a_paper_has_our_row_and_theirs():
    own = RunResult(
        spec=RunSpec(rule="gsfusion", label="GSFusion", preset="replica"),
        status="done",
        metrics={"n_frames": 4.0, "psnr_mapped_db": 31.25},
    )
    table = beside_papers(DATA_SETS["replica"], [own])
    assert table.headings[0] == "PSNR, dB ↑"
    assert (table.rows[0].scene, table.rows[0].cells[0].text) == ("here", "31.25")
    assert len(table.rows) == 1 + len(DATA_SETS["replica"].published)
    assert r"Wei \& Leutenegger 2024, Tables II and III & GSFusion & 34.65" in table.as_latex()
    assert not any(cell.best for row in table.rows for cell in row.cells)


def test_fidelity_and_device_are_those_that_are_asked_for(replica):
    def specs(**options):
        asked = BenchmarkOptions(name="replica", folder=str(replica / "room0"), **options)
        return benchmark_specs(DATA_SETS["replica"], asked)[0]

    assert {spec.fidelity for spec in specs(fidelity="paper")} == {"paper"}
    assert {spec.device for spec in specs()} == {"cpu"}
    with pytest.raises(ValueError, match="system gsfusion has no fidelity 'rrg'; it has: measured"):
        specs(fidelity="rrg")
    assert (
        specs(fidelity="rrg", systems=("gps_slam",))[0].config()
        != specs(systems=("gps_slam",))[0].config()
    )
    with pytest.raises(ValueError, match="--device gpu cannot be used here"):
        specs(device="gpu")


def test_a_setting_that_one_system_lacks_names_it(replica):
    options = BenchmarkOptions(
        name="replica", folder=str(replica / "room0"), set=("tsdf.voxel_size_m=0.05",)
    )
    with pytest.raises(ValueError, match=r"system rtg_slam: .*tsdf"):
        benchmark_specs(DATA_SETS["replica"], options)


OWN = """
[lab]
title = "Our room"
format = "replica"
views = "held_out"
scenes = ["room0"]
settings = { "data.hold_out_every" = 4, "data.hold_out_offset" = 1 }
[[lab.published]]
system = "Ours"
source = "We 2026, Table 1"
numbers = { psnr = 30.0 }

[replica]
[[replica.published]]
system = "NewSLAM"
source = "They 2026, Table 2"
numbers = { psnr = 41.0, ssim = 0.99 }
"""


def test_data_sets_and_rows_of_ones_own(replica, tmp_path):
    file = tmp_path / "sets.toml"
    file.write_text(OWN)
    own = data_set_of(f"{file}:lab")
    specs, _ = benchmark_specs(own, BenchmarkOptions(name="x", folder=str(replica / "room0")))
    assert specs[0].config().data.hold_out_every == 4
    assert "| Ours | 30.00 |" in report(own, [], {})
    extended = data_set_of(f"{file}:replica")
    assert extended.title == DATA_SETS["replica"].title
    assert len(extended.published) == len(DATA_SETS["replica"].published) + 1
    assert "| NewSLAM | 41.00 | 0.990 |" in report(extended, [], {})
    assert data_set_of("tum") is DATA_SETS["tum"]


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (OWN, "", "has 2 data sets, lab, replica; name one"),
        (OWN, ":other", "no data set in .*other"),
        ("[a]\ntitle = 3", "", r"\[a\]: title: expected str, got 3"),
        ("[a]\ntitle = 'A'", "", "expected format, scenes, views as well"),
        (OWN.replace('"replica"', '"raplica"', 1), ":lab", "no layout.*raplica"),
        (OWN.replace("psnr = 30", "psrn = 30"), ":lab", "no column.*psrn"),
        (OWN.replace("views", "view", 1), ":lab", "no key.*view"),
        ("[a", "", "sets.toml: "),
    ],
)
def test_mistakes_in_a_file_of_data_sets_are_named(tmp_path, text, name, message):
    file = tmp_path / "sets.toml"
    file.write_text(text)
    with pytest.raises((ValueError, KeyError), match=message):
        data_set_of(f"{file}{name}")


@pytest.mark.ci
def test_the_command_writes_the_table(replica, tmp_path, capsys):
    command = [
        "benchmark",
        "replica",
        str(replica / "room0"),
        "--systems",
        "gsfusion",
        "--out",
        str(tmp_path / "out"),
    ]
    assert cli([*command, "--set", *QUICK]) == 0
    text = (tmp_path / "out/benchmark.md").read_text()
    assert text in capsys.readouterr().out
    assert "| **GSFusion, here** |" in text
    assert (tmp_path / "out/runs.csv").is_file()
    assert cli(["benchmark", "replica", str(tmp_path / "nowhere")]) == 1
    assert "holds no scene in the layout replica" in capsys.readouterr().err
