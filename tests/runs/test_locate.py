"""A recording is located in the map of another run: all that the map shows, nothing else, from
anywhere, without poses and times."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from earlier_runs import hashes

from gsfusion_nb.cli import main
from gsfusion_nb.config import gsfusion
from gsfusion_nb.data.room import room
from gsfusion_nb.export.trajectory import read_trajectory_tum
from gsfusion_nb.mapping import get_system
from gsfusion_nb.runs import locate, run_mapping

ROOM: dict[str, Any] = {"n_frames": 120, "width": 160, "height": 120}
SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.04,
    "tsdf__truncation_voxels": 4.0,
    "sh_degree": 0,
    "data__stop": 12,
    "optim__global_iterations": 0,
    "seeding__quadtree_threshold": 0.05,
}


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    """The folder of a run on the first frames of the walk."""
    folder = tmp_path_factory.mktemp("mapped") / "run"
    run_mapping("room", gsfusion("replica", **SMALL), folder=folder, evaluate=False, **ROOM)
    return folder


@dataclasses.dataclass(frozen=True)
class Backwards:
    """Frames in another order, without poses and without times that mean anything."""

    source: Any
    order: tuple[int, ...]
    name: str = "backwards"
    has_poses: bool = False

    @property
    def camera(self):
        return self.source.camera

    def __len__(self):
        return len(self.order)

    def __getitem__(self, i):
        if i >= len(self.order):
            raise IndexError(i)
        frame = self.source[self.order[i]]
        return dataclasses.replace(frame, index=i, timestamp_s=math.nan, T_WC=torch.eye(4))

    def pose(self, i):
        return torch.eye(4)


def test_frames_of_the_map_are_located_and_others_are_not(mapped, tmp_path):
    before = hashes(mapped)
    options = dataclasses.replace(gsfusion("replica").data, hold_out_every=0, stop=70, stride=6)
    found = locate(mapped, "room", folder=tmp_path / "out", frames=options, **ROOM)
    assert hashes(mapped) == before
    errors = {row.index: row.error for row in found.frames}
    assert list(errors) == list(range(0, 70, 6))
    for index in (0, 6, 12):
        distance_m, angle_deg = errors[index] or (9.0, 90.0)
        assert distance_m < 0.02
        assert angle_deg < 0.5
    for row in found.frames:  # the camera looks at other walls
        if row.index >= 36:
            assert not row.location.is_located
            assert f"frame {row.index}" in row.location.reason
        assert row.error is None or row.error[0] < 0.03
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert document["metrics"]["n_located"] == len(found.poses)
    assert document["metrics"]["share_located"] == len(found.poses) / 12
    times_s, poses = read_trajectory_tum(tmp_path / "out" / "trajectory.txt")
    assert len(times_s) == len(found.poses)
    first = min(found.poses)
    assert torch.allclose(poses[0].float(), found.poses[first], atol=1e-6)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Map from the pose" in page
    assert "not located" in page


def test_without_poses_and_times_from_any_place(mapped, tmp_path):
    source = room(**ROOM)
    order = (9, 5, 60, 1)
    found = locate(mapped, Backwards(source, order), folder=tmp_path / "out")
    assert [row.location.is_located for row in found.frames] == [True, True, False, True]
    for i, T_WC in found.poses.items():
        assert (T_WC[:3, 3] - source.true_pose(order[i])[:3, 3]).norm() < 0.02
    times_s, _ = read_trajectory_tum(tmp_path / "out" / "trajectory.txt")
    assert times_s == [0, 1, 3]
    assert "not_computed" in found.folder.joinpath("metrics.json").read_text()


def test_a_recording_of_another_size(mapped, tmp_path):
    small = room(n_frames=120, width=112, height=84)
    found = locate(
        mapped,
        Backwards(small, (3, 7)),
        folder=tmp_path / "out",
        frames=dataclasses.replace(gsfusion("replica").data, hold_out_every=0),
    )
    for i, T_WC in found.poses.items():
        assert (T_WC[:3, 3] - small.true_pose((3, 7)[i])[:3, 3]).norm() < 0.04
    assert len(found.poses) == 2


@pytest.mark.parametrize("system", ["rtg_slam", "gps_slam"])
def test_each_system_keeps_what_finds_a_camera(system, tmp_path):
    config = get_system(system).preset("replica", data__stop=8, data__hold_out_every=0)
    run_mapping("room", config, folder=tmp_path / "run", evaluate=False, **ROOM)
    found = locate(tmp_path / "run", Backwards(room(**ROOM), (2, 60)), folder=tmp_path / "out")
    assert list(found.poses) == [0]
    assert (found.poses[0][:3, 3] - room(**ROOM).true_pose(2)[:3, 3]).norm() < 0.03


def test_nothing_located_is_status_3_and_a_run_without_places_a_sentence(mapped, tmp_path, capsys):
    words = ["locate", str(mapped), "room", "--out", str(tmp_path / "out")]
    frames = ["--start", "60", "--stop", "62", "--reader", "n_frames=120"]
    assert main([*words, *frames]) == 3
    said = capsys.readouterr().out
    assert "2 of 2 frames were not located" in said
    assert not (tmp_path / "out" / "trajectory.txt").exists()
    old = tmp_path / "old"
    old.mkdir()
    for name in ("config.json", "gaussians.ply", "tsdf.npz"):
        (old / name).write_bytes((mapped / name).read_bytes())
    assert main(["locate", str(old), "room"]) == 1
    assert "places.npz does not exist" in capsys.readouterr().err
    assert main(["locate", str(tmp_path / "nothing"), "room"]) == 1
    assert "expected the folder of a run" in capsys.readouterr().err
