"""Running the variants of a study: each a run of its own, complete ones kept, failures said."""

import json

import pytest

from gsfusion_nb.studies import STUDIES, StudyOptions, main
from gsfusion_nb.studies import run as study_run
from gsfusion_nb.studies.run import as_markdown, run_variant

FAST = "--data.stop 4 --data.width 80 --data.height 60 --window.iterations 2 --final.passes 1 --keyframes.iterations 1"


def test_a_variant_runs_once_and_failures_are_a_sentence(tmp_path):
    arguments = ["--system", "rtg_slam", *FAST.split()]
    metrics = run_variant("room", tmp_path / "a", arguments)
    assert metrics["n_frames"] == 4
    written = (tmp_path / "a" / "metrics.json").stat().st_mtime_ns
    assert run_variant("room", tmp_path / "a", arguments) == metrics
    assert (tmp_path / "a" / "metrics.json").stat().st_mtime_ns == written
    failed = run_variant(str(tmp_path / "nowhere"), tmp_path / "b", arguments)
    assert "is not a folder" in failed["error"]


def test_the_table_has_a_row_per_variant(tmp_path, monkeypatch, capsys):
    asked = []

    def fake(data, folder, arguments):
        asked.append((data, folder.name, arguments))
        return {"psnr_held_out_db": 20.0 + len(asked), "n_gaussians": 1000} if len(asked) < 4 else {"error": "broke"}

    monkeypatch.setattr(study_run, "run_variant", fake)
    assert main(StudyOptions(name="systems", data="room", out=str(tmp_path), options="--data.stop 9")) == 1
    assert len(asked) == len(STUDIES["systems"].variants)
    assert all(arguments[-2:] == ["--data.stop", "9"] for _, _, arguments in asked)
    table = (tmp_path / "table.md").read_text(encoding="utf-8").replace("\xa0", " ")
    assert "| RTG-SLAM, given | 22.00 dB | 1,000 |" in table
    assert json.loads((tmp_path / "table.json").read_text())["RTG-SLAM, tracked"] == {"error": "broke"}
    assert "RTG-SLAM, tracked: broke" in capsys.readouterr().out


def test_columns_that_nobody_has_are_left_out():
    assert "ATE" not in as_markdown({"a": {"psnr_held_out_db": 1.0}})


def test_unknown_study_is_refused(tmp_path):
    with pytest.raises(KeyError, match="no study 'colours'"):
        main(StudyOptions(name="colours", out=str(tmp_path)))
