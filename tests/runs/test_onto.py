"""A recording goes on in the map of another run, which stays as it is; so does its resume."""

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from earlier_runs import ROOM, StopAfter, hashes, map_first_frames

from gsfusion_nb.cli import main
from gsfusion_nb.config import gps_slam, replace
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.export import read_gaussian_ply
from gsfusion_nb.mapping import get_system
from gsfusion_nb.runs import CheckpointEvery, resume_mapping, run_mapping
from gsfusion_nb.runs.map_state import read_map_state
from gsfusion_nb.runs.onto import read_parent, settings_onto


@pytest.fixture(scope="module")
def parent(tmp_path_factory) -> Path:
    """The folder of a run on the first frames of the walk."""
    return map_first_frames(tmp_path_factory.mktemp("parent") / "run")


def settings(parent: Path, **changes: Any) -> Any:
    """Settings of the frames that come next."""
    values = {"data__start": 8, "data__stop": 16} | changes
    return replace(settings_onto(read_parent(parent).config), **values)


@pytest.fixture(scope="module")
def whole(parent, tmp_path_factory):
    """A run onto the parent that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return run_mapping("room", settings(parent), onto=parent, folder=folder, evaluate=False, **ROOM)


def test_the_camera_is_located_and_the_map_goes_on(parent, whole):
    config = json.loads((parent / "config.json").read_text())
    assert "onto" not in config
    first = read_gaussian_ply(parent / "gaussians.ply")
    mapper = whole.mapper
    assert whole.run.status == "complete"
    assert len(whole.run.steps) == 8
    assert [step.tracking["status"] for step in whole.run.steps] == ["located"] + ["ok"] * 7
    assert mapper.n_frames == 18
    assert len(mapper.gaussians) > len(first)
    assert mapper.trajectory.frame_indices[10:] == list(range(8, 16))
    assert max(mapper.trajectory.frame_indices[:10]) < 0
    assert len(whole.run.poses) == 8
    source = room(**ROOM)
    for k, T_WC in enumerate(whole.run.poses):
        assert (T_WC[:3, 3] - source.true_pose(8 + k)[:3, 3]).norm() < 0.02
    earlier = [k for k in mapper.keyframes if k.index < 0]
    assert len(earlier) >= 2
    assert (mapper.gaussians.birth_frame[: len(first)] == -1).any()


def test_the_new_run_names_its_parent(parent, whole):
    numbers = json.loads((whole.folder / "metrics.json").read_text())
    settings_file = json.loads((whole.folder / "config.json").read_text())
    maps = json.loads((parent / "metrics.json").read_text())["sha256"]
    for document in (numbers, settings_file):
        assert document["onto"] == {"run": str(parent.resolve()), "sha256": maps}
    assert numbers["metrics"]["n_frames"] == 8
    assert len((whole.folder / "trajectory.txt").read_text().splitlines()) == 9


def test_files_of_the_parent_stay_and_a_report_is_written(parent, tmp_path):
    before = hashes(parent)
    words = ["map", "room", "--onto", str(parent), "--out", str(tmp_path / "run")]
    options = ["--data.start", "8", "--data.stop", "14"]
    held_out = ["--data.hold-out-every", "3", "--data.hold-out-offset", "1"]
    size = ["--reader", "n_frames=120", "width=160", "height=120"]
    assert main([*words, *options, *held_out, *size]) == 0
    assert hashes(parent) == before
    page = (tmp_path / "run" / "report.html").read_text()
    assert f"in the map of {parent.name}" in page
    numbers = json.loads((tmp_path / "run" / "metrics.json").read_text())["metrics"]
    assert numbers["ate_rmse_m"] < 0.02
    assert numbers["psnr_held_out_db"] > 18
    assert main(["eval", str(tmp_path / "run")]) == 0
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert again["metrics"]["psnr_held_out_db"] == numbers["psnr_held_out_db"]


def test_a_run_goes_on_in_the_map_of_a_run_that_went_on(whole, tmp_path):
    config = settings(whole.folder, data__start=14, data__stop=18)
    third = run_mapping(
        "room", config, onto=whole.folder, folder=tmp_path / "third", evaluate=False, **ROOM
    )
    assert third.mapper.n_frames == 22
    indices = third.mapper.trajectory.frame_indices
    assert indices == sorted(indices)
    assert indices[-4:] == [14, 15, 16, 17]


def test_a_resumed_run_ends_with_the_same_maps(parent, whole, tmp_path):
    with pytest.raises(RuntimeError, match="stopped"):
        run_mapping(
            "room",
            settings(parent),
            onto=parent,
            folder=tmp_path / "run",
            evaluate=False,
            watch=StopAfter(4),
            checkpoints=CheckpointEvery(frames=1),
            **ROOM,
        )
    resumed = resume_mapping(tmp_path / "run", evaluate=False)
    assert resumed.run.parent == whole.run.parent
    assert resumed.run.hashes == whole.run.hashes
    numbers = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert numbers["onto"] == whole.run.parent


@pytest.mark.ci
@pytest.mark.parametrize("system", ["rtg_slam", "gps_slam"])
def test_other_systems_go_on(system, tmp_path):
    config = get_system(system).preset("replica", data__stop=8, data__hold_out_every=0)
    run_mapping("room", config, folder=tmp_path / "first", evaluate=False, **ROOM)
    config = settings(tmp_path / "first", data__start=2, data__stop=6)
    second = run_mapping(
        "room", config, onto=tmp_path / "first", folder=tmp_path / "second", evaluate=False, **ROOM
    )
    assert second.mapper.n_frames == 12
    source = room(**ROOM)
    for k, T_WC in enumerate(second.run.poses):
        assert (T_WC[:3, 3] - source.true_pose(2 + k)[:3, 3]).norm() < 0.02


def test_what_cannot_go_together_is_refused(parent, tmp_path, capsys):
    words = ["map", "room", "--onto", str(parent), "--out", str(tmp_path / "run")]
    for option, said in (
        (["--system", "rtg_slam"], "was mapped by the system 'gsfusion', not by 'rtg_slam'"),
        (["--tsdf.voxel-size-m", "0.02"], "tsdf.voxel_size_m 0.04, not 0.02"),
        (["--sh-degree", "2"], "sh_degree 0, not 2"),
        (["--tracking.back-end"], "tracking.back_end cannot be used"),
        (["--preset", "tum"], "leave out --preset"),
        (["--from-gaussians", str(parent / "gaussians.ply")], "not with both"),
    ):
        assert main([*words, *option]) == 1
        assert said in capsys.readouterr().err.replace("\n", " ")
    with pytest.raises(ValueError, match="gsfusion; gps_slam cannot go on in its map"):
        run_mapping("room", gps_slam("room"), onto=parent, folder=tmp_path / "run", **ROOM)
    assert main(["map", "room", "--onto", str(tmp_path / "none")]) == 1
    assert "expected the folder of a finished run" in capsys.readouterr().err


def test_frames_of_another_place_are_not_mapped(parent, tmp_path):
    config = settings(parent, data__start=60, data__stop=63)
    with pytest.raises(SequenceError, match="none of the 3 frames could be mapped"):
        run_mapping("room", config, onto=parent, folder=tmp_path / "run", evaluate=False, **ROOM)


def test_another_camera_goes_on(parent, tmp_path):
    small: dict[str, Any] = ROOM | {"width": 128, "height": 96}
    config = dataclasses.replace(settings(parent))
    run = run_mapping("room", config, onto=parent, folder=tmp_path / "run", evaluate=False, **small)
    source = room(**small)
    for k, T_WC in enumerate(run.run.poses):
        assert (T_WC[:3, 3] - source.true_pose(8 + k)[:3, 3]).norm() < 0.03


@pytest.mark.parametrize("name", ["state.zip", "places.npz", "tsdf.npz", "gaussians.ply"])
def test_a_damaged_file_is_a_sentence(parent, tmp_path, name):
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in parent.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    (copy / name).write_bytes((copy / name).read_bytes()[:-300])
    with pytest.raises(ValueError, match=f"{name}|{copy}"):
        run_mapping("room", settings(copy), onto=copy, folder=tmp_path / "run", **ROOM)
    (copy / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        run_mapping("room", settings(parent), onto=copy, folder=tmp_path / "run", **ROOM)


def test_a_wrong_value_in_the_state_is_refused(parent, tmp_path):
    state = read_map_state(parent / "state.zip")
    rows = state["gaussians"]["rows"]
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in parent.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())

    for change in (
        {"n_frames": -1},
        {"n_frames": 11},
        {"poses": 2 * state["poses"]},
        {"frame_indices": state["frame_indices"].float()},
        {"keyframes": state["keyframes"][0]},
        {"keyframes": [*state["keyframes"], state["keyframes"][-1]]},
        {"keyframes": [state["keyframes"][0] | {"T_WC": None}]},
        {"frame_indices": state["frame_indices"][:0]},
        {"rule": state["rule"] | {"name": None}},
        {"rule": state["rule"] | {"memory": []}},
        {"gaussians": state["gaussians"] | {"more": 1}},
        {"gaussians": state["gaussians"] | {"rows": rows | {"last_step": rows["last_step"] * 1.0}}},
    ):
        document = {"format": "gsfusion_nb map state", "version": 1, "state": state | change}
        with (
            zipfile.ZipFile(copy / "state.zip", "w") as archive,
            archive.open("state.pt", "w") as file,
        ):
            torch.save(document, file)
        with pytest.raises(ValueError, match="copy"):
            run_mapping("room", settings(parent), onto=copy, folder=tmp_path / "run", **ROOM)
    assert torch.equal(state["poses"], read_map_state(parent / "state.zip")["poses"])
