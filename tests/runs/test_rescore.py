"""``gsfusion-nb eval`` gives the run's own numbers, and says so where it does not."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.runs import rescore, run_mapping

DATA: dict[str, Any] = {"data__stop": 8, "data__hold_out_every": 4, "data__hold_out_offset": 2}
ROOM: dict[str, Any] = {"n_frames": 480, "width": 80, "height": 60}
SETTINGS = {
    "gsfusion": gsfusion(
        "online",
        **DATA,
        data__align_held_out=True,
        tsdf__voxel_size_m=0.04,
        tsdf__truncation_voxels=4.0,
        sh_degree=1,
        keyframe_min_seeds=20,
    ),
    "rtg_slam": rtg_slam("room", data__width=0, data__height=0, **DATA),
    "gps_slam": gps_slam(
        "room", data__width=0, data__height=0, **DATA, data__align_held_out=True, tsdf__voxel_size_m=0.04
    ),
}
SCORES = ("psnr_", "ssim_", "depth_l1_", "n_views_")


def with_poses(system: str, poses: str):
    return replace(SETTINGS[system], tracking__poses=poses)


@pytest.fixture(scope="module")
def mapped_once() -> dict[tuple[str, str], tuple[Path, dict]]:
    """Folder and numbers of the runs that tests of this file share."""
    return {}


@pytest.fixture
def scored_run(mapped_once, tmp_path, tmp_path_factory):
    """``scored_run(system, poses)``: folder and numbers of a complete run; the folder is a copy for this test."""

    def copied(system: str, poses: str) -> tuple[Path, dict]:
        if (system, poses) not in mapped_once:
            folder = tmp_path_factory.mktemp("mapped") / "run"
            run = run_mapping("room", with_poses(system, poses), folder=folder, **ROOM)
            mapped_once[system, poses] = run.folder, run.metrics
        folder, numbers = mapped_once[system, poses]
        return shutil.copytree(folder, tmp_path / "run"), numbers

    return copied


@pytest.mark.parametrize(
    ("system", "poses"),
    [
        *((system, poses) for system in ("gsfusion", "rtg_slam") for poses in ("given", "tracked")),
        ("gps_slam", "given"),
    ],
)
def test_scoring_again_gives_the_same_numbers(system, poses, scored_run, caplog):
    folder, _ = scored_run(system, poses)
    before = (folder / "metrics.json").read_text()
    own = {name: value for name, value in json.loads(before)["metrics"].items() if name.startswith(SCORES)}
    assert own["n_views_held_out"] == 2
    assert own["n_views_mapped"] == 6
    aligned = system != "rtg_slam"
    assert own.get("n_views_held_out_aligned", 0) == (2 if aligned else 0)
    assert not aligned or own["psnr_held_out_aligned_db"] >= own["psnr_held_out_db"]
    assert own.get("n_views_held_out_fitted", 0) == (2 if aligned else 0)
    assert not aligned or own["psnr_held_out_fitted_db"] >= own["psnr_held_out_aligned_db"] - 0.05
    again = rescore(folder)
    assert {name: again[name] for name in own} == own
    assert (folder / "metrics.json").read_text() == before
    assert [r.getMessage() for r in caplog.records if not r.name.endswith(".announce")] == []  # that kernels compile
    assert not list(folder.glob("metrics-*"))


def test_views_between_fitted_exposures_are_shown_with_theirs_and_scored_again_alike(tmp_path):
    config = replace(SETTINGS["gsfusion"], keyframe_every=1, optim__fit_exposure=True, data__align_held_out=False)
    config = replace(config, optim__global_iterations=3)
    reader = {**ROOM, "exposure_stops": 1.0}
    run = run_mapping("room", config, folder=tmp_path / "run", **reader)
    assert run.metrics["n_views_held_out_between"] == 2
    assert run.metrics["psnr_held_out_between_db"] > run.metrics["psnr_held_out_db"] + 1
    own = {name: value for name, value in run.metrics.items() if name.startswith(SCORES)}
    again = rescore(run.folder)
    assert {name: again[name] for name in own} == own
    path = run.folder / "views.json"
    path.write_text(path.read_text().replace('"gain": [', '"gain": [1.0, '))
    with pytest.raises(ValueError, match=r"views.json is damaged: gain of frame \d+ must"):
        rescore(run.folder)


@pytest.mark.parametrize(("scored", "n"), [(0, 6), (3, 3), (1, 1)])
def test_as_many_mapped_views_are_scored_as_the_settings_say(scored, n, tmp_path):
    config = replace(SETTINGS["gsfusion"], data__scored_views=scored)
    run = run_mapping("room", config, folder=tmp_path / "run", **ROOM)
    assert run.metrics["n_views_mapped"] == n
    assert json.loads((run.folder / "config.json").read_text())["fidelity"].startswith("measured")


def test_a_run_that_was_not_scored_gets_its_numbers_later(scored_run, tmp_path):
    _, scored = scored_run("gsfusion", "tracked")
    plain = run_mapping("room", with_poses("gsfusion", "tracked"), folder=tmp_path / "plain", evaluate=False, **ROOM)
    assert "psnr_mapped_db" not in plain.metrics
    later = rescore(plain.folder)
    for name in ("psnr_mapped_db", "psnr_held_out_db", "depth_l1_held_out_m"):
        assert later[name] == scored[name]


def test_numbers_that_differ_are_named_and_the_run_s_are_kept(scored_run, caplog):
    folder, _ = scored_run("gsfusion", "given")
    path = folder / "metrics.json"
    document = json.loads(path.read_text())
    true = document["metrics"]["psnr_mapped_db"]
    document["metrics"] |= {"psnr_mapped_db": 99.0, "lpips_mapped": 0.25}
    path.write_text(json.dumps(document))
    again = rescore(folder)
    assert again["psnr_mapped_db"] == true
    assert again["lpips_mapped"] == 0.25  # not asked for now, so what is there stays
    kept = json.loads((folder / "metrics-before-eval.json").read_text())
    assert kept["metrics"]["psnr_mapped_db"] == 99.0
    sentence = f"these scores differ from those of the run: psnr_mapped_db 99 -> {true:.6g}"
    assert sentence in caplog.text
    assert sentence in json.loads(path.read_text())["warnings"][-1]


def test_a_run_without_its_views_is_refused(scored_run):
    folder, _ = scored_run("gsfusion", "given")
    (folder / "views.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"views.json does not exist, so the views to score"):
        rescore(folder)
    (folder / "views.json").write_text('{"mapped": [{"frame": 0}]}')
    with pytest.raises(ValueError, match=r"views.json is damaged: KeyError 'T_WC'"):
        rescore(folder)


def test_other_data_than_the_run_s_are_named(scored_run, caplog):
    folder, _ = scored_run("gsfusion", "given")
    path = folder / "config.json"
    settings = json.loads(path.read_text())
    assert len(settings["data_content"]) == 32
    settings["source"]["n_frames"] = 240
    path.write_text(json.dumps(settings))
    for _ in range(2):
        rescore(folder)
    sentence = "room does not hold the data that this run was mapped from"
    assert sentence in caplog.text
    warnings = json.loads((folder / "metrics.json").read_text())["warnings"]
    assert sum(sentence in warning for warning in warnings) == 1


def test_the_device_of_a_run_may_be_gone_but_not_nonsense(scored_run, monkeypatch):
    folder, numbers = scored_run("gsfusion", "given")
    path = folder / "config.json"
    settings = json.loads(path.read_text())
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    path.write_text(json.dumps(settings | {"device": "cuda:0"}))
    assert rescore(folder)["psnr_mapped_db"] == numbers["psnr_mapped_db"]
    for device in ("", "meta", None, "a" * 5000):
        path.write_text(json.dumps(settings | {"device": device}))
        with pytest.raises(ValueError, match=r"config\.json: device must be cpu or cuda, got "):
            rescore(folder)
