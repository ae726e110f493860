"""The plug-in of VSLAM-LAB: its command line, and a sequence in that program's format tracked and
mapped."""

import csv
import shlex
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.evaluation import trajectory_scores
from gsfusion_nb.geometry.quaternion import to_matrix


@pytest.fixture
def plugin(monkeypatch):
    """The plug-in as VSLAM-LAB imports it."""

    class Base:
        def __init__(self, name, folder, parameters):
            self.baseline_name = name
            self.baseline_folder = folder
            self.default_parameters = parameters

    package = ModuleType("Baselines")
    base = ModuleType("Baselines.BaselineVSLAMLab")
    base.BaselineVSLAMLab = Base  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "Baselines", package)
    monkeypatch.setitem(sys.modules, "Baselines.BaselineVSLAMLab", base)
    monkeypatch.delitem(sys.modules, "vslamlab_baseline", raising=False)
    import vslamlab_baseline

    return vslamlab_baseline


def written(frames, folder: Path) -> None:
    """Frames as VSLAM-LAB stores a sequence and an experiment's choice of it."""
    camera = frames[0].camera
    for name in ("rgb_0", "depth_0"):
        (folder / name).mkdir(parents=True)
    rows = ["ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0"]
    for i, frame in enumerate(frames):
        ns = 10**18 + round(1e9 * frame.timestamp_s)
        file = f"{i:04}.png"
        cv2.imwrite(
            str(folder / "rgb_0" / file),
            cv2.cvtColor(frame.rgb_u8.numpy(), cv2.COLOR_RGB2BGR),
        )
        cv2.imwrite(
            str(folder / "depth_0" / file),
            (frame.depth_m * 5000).round().to(torch.uint16).numpy(),
        )
        rows.append(f"{ns},rgb_0/{file},{ns},depth_0/{file}")
    (folder / "rgb_exp.csv").write_text("\n".join(rows) + "\n")
    (folder / "calibration.yaml").write_text(
        "%YAML:1.0\ncameras:\n- {cam_name: rgb_0, cam_type: rgb+depth, depth_name: depth_0, "
        f"cam_model: pinhole, focal_length: [{camera.fx}, {camera.fy}], principal_point: "
        f"[{camera.cx - 0.5}, {camera.cy - 0.5}], image_dimension: [{camera.width}, "
        f"{camera.height}], depth_factor: 5000.0, fps: 30.0}}\n"
    )


def test_a_sequence_of_vslam_lab_is_tracked(plugin, tmp_path):
    slow = room(n_frames=960, width=80, height=60)
    frames = [slow[i] for i in range(8)]
    written(frames, tmp_path / "data" / "room")
    dataset = SimpleNamespace(dataset_path=tmp_path / "data", dataset_folder="ROOM")
    folder = tmp_path / "experiment" / "ROOM" / "room"
    folder.mkdir(parents=True)
    (tmp_path / "data" / "room" / "rgb_exp.csv").rename(folder / "rgb_exp.csv")
    exp = SimpleNamespace(folder=tmp_path / "experiment", parameters={"width": 80, "height": 60})
    command = plugin.GSFUSIONNB_baseline("gps_slam").build_execute_command(3, exp, dataset, "room")
    _, program, *arguments = shlex.split(command)
    assert Path(program).is_file()
    assert plugin.main(arguments) == 0
    with open(folder / "00003_KeyFrameTrajectory.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["ts (ns)"]) for row in rows] == [
        10**18 + round(1e9 * f.timestamp_s) for f in frames
    ]
    found = torch.eye(4, dtype=torch.float64).repeat(8, 1, 1)
    found[:, :3, 3] = torch.tensor([[float(row[f"t{a} (m)"]) for a in "xyz"] for row in rows])
    found[:, :3, :3] = to_matrix(
        torch.tensor([[float(row[f"q{a}"]) for a in "wxyz"] for row in rows]).double()
    )
    truth = torch.stack([f.T_WC for f in frames]).double()
    assert trajectory_scores(found, truth)["ate_rmse_m"] < 0.02
    assert (folder / "00003_gps_slam" / "gaussians.ply").is_file()
