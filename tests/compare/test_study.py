"""Running the variants of a study: each a run of its own, complete ones kept, failures said."""

import functools
import json
import shutil
from typing import Any

import pytest

from gsfusion_nb.cli.map import MapOptions
from gsfusion_nb.cli.settings import parse
from gsfusion_nb.compare import STUDIES, StudyOptions, main
from gsfusion_nb.compare import spec as run_key_module
from gsfusion_nb.compare import study as study_run
from gsfusion_nb.compare.rate import draw_rates
from gsfusion_nb.compare.study import as_markdown, run_variant
from gsfusion_nb.config import to_dict

FAST = (
    "--data.stop 3 --data.width 80 --data.height 60 --tsdf.voxel-size-m 0.1 --optim.global-iterations 0 --no-evaluate"
)


@pytest.mark.ci
def test_a_variant_runs_once_and_failures_are_a_sentence(tmp_path):
    arguments: list[str] = list(FAST.split())
    metrics = run_variant("room", tmp_path / "a", arguments)
    assert metrics["n_frames"] == 3
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


def test_only_the_variants_whose_name_has_the_text_are_run(tmp_path, monkeypatch):
    monkeypatch.setattr(study_run, "run_variant", lambda data, folder, arguments: {"n_gaussians": 1})
    assert main(StudyOptions(name="systems", out=str(tmp_path), only="GIVEN")) == 0
    assert list(json.loads((tmp_path / "table.json").read_text())) == [
        "GSFusion, given", "RTG-SLAM, given", "GPS-SLAM, given"
    ]  # fmt: skip
    with pytest.raises(ValueError, match="'taken'; there are GSFusion, given"):
        main(StudyOptions(name="systems", out=str(tmp_path), only="taken"))


@functools.cache
def settings_of(name: str, variant: str) -> Any:
    """Settings of a variant of a study on the first nine frames of the room."""
    arguments = [*STUDIES[name].variants[variant], "--data.stop", "9"]
    return parse(MapOptions, "map", ["room", *arguments], data="data").settings()


@pytest.mark.parametrize(("name", "variant"), [(name, v) for name, study in STUDIES.items() for v in study.variants])
def test_the_options_of_every_variant_are_understood(name, variant):
    assert settings_of(name, variant).data.stop == 9


@pytest.mark.parametrize("name", ["gsfusion-settings", "rtg-slam-settings"])
def test_each_variant_of_a_study_of_settings_changes_one(name):
    """As its label says: the group and the name of the field, or an option of the rule."""
    configs = {label: settings_of(name, label) for label in STUDIES[name].variants}
    base = to_dict(configs.pop("measured"))
    for label, config in configs.items():
        group, _, field = label.split()[0].rpartition(".")
        changed = [
            (g, f) for g, values in to_dict(config).items() if isinstance(values, dict)
            for f in values if values[f] != base[g][f]
        ]  # fmt: skip
        assert {g for g, _ in changed} == {group or "seeding"}
        assert all(f.startswith(field) or (field == "share" and f == "options") for _, f in changed), label


def test_rates_are_drawn_without_the_variants_that_failed(tmp_path):
    metrics = {"fps_total": 12.5, "psnr_held_out_db": 25.0}
    faster = {"fps_total": 30.0, "psnr_held_out_db": 24.0}
    draw_rates({"a": metrics, "b": {"error": "broke"}, "c": faster}, tmp_path / "rate.png")
    assert (tmp_path / "rate.png").stat().st_size > 5000


def test_columns_that_nobody_has_are_left_out():
    assert "ATE" not in as_markdown({"a": {"psnr_held_out_db": 1.0}})


def test_unknown_study_is_refused(tmp_path):
    with pytest.raises(KeyError, match="no study 'weather'"):
        main(StudyOptions(name="weather", out=str(tmp_path)))


def test_results_of_other_data_or_options_are_never_reused(tmp_path, monkeypatch, capsys, scene):
    """The folder of a run is named by a key of its content; what is complete there is reused, and said to be."""
    made = []

    def fake(data, folder, arguments):
        if not study_run.is_complete(folder):
            made.append(folder)
            folder.mkdir(parents=True)
            (folder / "metrics.json").write_text(json.dumps({"status": "complete", "metrics": {}}))
        return {"n_gaussians": len(made)}

    monkeypatch.setattr(study_run, "run_variant", fake)
    scan = tmp_path / "scan"
    shutil.copytree(scene, scan)
    settings = tmp_path / "config.json"
    settings.write_text("{}")

    def study(**changes) -> int:
        before = len(made)
        values: dict[str, Any] = {"name": "states", "data": str(scan), "out": str(tmp_path / "out")} | changes
        assert main(StudyOptions(**values)) == 0
        return len(made) - before

    assert study() == 2
    capsys.readouterr()
    assert study() == 0
    text = capsys.readouterr().out
    assert all(f"reused from {folder}" in text for folder in made)
    poses = (scan / "poses.txt").read_text()
    (scan / "poses.txt").write_text(poses.replace("5", "6", 1))  # the same name and size
    assert study() == 2
    assert study(options="--seed 1") == 2
    assert study(options=f"--from-config {settings}") == 2
    settings.write_text('{"sh_degree": 0}')
    assert study(options=f"--from-config {settings}") == 2
    assert study(options=f"--from-config {settings}") == 0
    assert study(options=f"--from-config {settings}", cache=False) == 2
    monkeypatch.setattr(run_key_module, "package_fingerprint", lambda: "edited")
    assert study() == 2
