"""The SplaTAM-like system of docs/examples: what it keeps, where it seeds, how it tracks, and the
commands of the page."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from splatam_like import SplatamLike

from gsfusion_nb.cli import main
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import get_system, make_mapper
from gsfusion_nb.runs.system_of_run import code_of_system
from gsfusion_nb.seeding.rule import keep_registered
from gsfusion_nb.types import Frame

FILE = Path(__file__).resolve().parents[2] / "docs/examples/splatam_like.py"
SIZE = {"data__width": 64, "data__height": 48}


def frame(index: int = 0) -> Frame:
    return room(n_frames=480, width=64, height=48)[index]


@pytest.fixture(scope="module")
def mapper():
    """After two frames with given poses."""
    mapper = SplatamLike(SplatamLike.preset("room", tracking__poses="given", steps=30, **SIZE))
    reports = [mapper.step(frame(i)) for i in range(2)]
    assert reports[0].n_seeds == 64 * 48
    assert reports[1].n_seeds < 64 * 48 / 5
    assert reports[0].losses[-1] < reports[0].losses[0]
    return mapper


def test_it_fits_in_200_lines():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) <= 200


def test_the_copy_in_a_runs_folder_is_the_same_system(tmp_path):
    """A run that was interrupted is continued by it."""
    copy = shutil.copy(FILE, tmp_path / "system.py")
    with keep_registered():
        systems = [get_system(f"{file}:SplatamLike") for file in (FILE, copy)]
        parts = [code_of_system(make_mapper(system.preset("room"))) for system in systems]
    assert systems[0] is not systems[1]
    assert parts[0] == parts[1]
    assert parts[0]["values"]


def test_gaussians_stay_round(mapper):
    log_scale = mapper.gaussians.params.log_scale
    assert torch.equal(log_scale, log_scale[:, :1].expand(-1, 3))
    assert log_scale[:, 0].unique().numel() > 100
    assert mapper.gaussians.params.quat[:, 1:].abs().max() == 0
    assert mapper.gaussians.opacity.min() >= 0.004


def test_the_pose_gradient_leads_back(mapper):
    seen = mapper.render(frame(0).camera, frame(0).T_WC)
    pictured = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=seen.rgb,
        depth_m=seen.depth_m,
        camera=frame(0).camera,
        T_WC=frame(0).T_WC,
    )
    wrong = frame(0).T_WC @ se3.exp(torch.tensor([0.02, -0.01, 0.01, 0.004, 0.006, -0.004]))
    right = mapper.find_pose(pictured, wrong)
    before_deg, before_m = se3.motion(wrong, pictured.T_WC)
    after_deg, after_m = se3.motion(right, pictured.T_WC)
    assert after_m < before_m / 4
    assert after_deg < before_deg / 3


def test_where_the_map_shows_nothing_tracking_is_lost(mapper):
    away = frame(0).T_WC.clone()
    away[:3, 3] += 100
    with pytest.raises(ValueError, match="the map shows nothing there"):
        mapper.find_pose(frame(0), away)
    tracked = SplatamLike(SplatamLike.preset("room", steps=1, min_silhouette=0.9999999, **SIZE))
    tracked.step(frame(0))
    with pytest.raises(BadFrameError, match="frame 1 cannot be tracked"):
        tracked.step(frame(1))
    assert tracked.n_frames == 1


def test_map_and_eval_as_a_user_types_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("splatam_like.py").write_text(FILE.read_text(encoding="utf-8"), encoding="utf-8")
    typed = ["map", "room", "--system", "splatam_like.py:SplatamLike", "--out", "run"]
    small = ["--data.width", "48", "--data.height", "36", "--data.stop", "4", "--steps", "8"]
    assert main([*typed, *small, "--track-steps", "4", "--reader", "n_frames=480"]) == 0
    scores = json.loads(Path("run/metrics.json").read_text())["metrics"]
    assert scores["ate_rmse_m"] < 0.3
    with keep_registered():
        assert main(["eval", "run", "--system", "splatam_like.py:SplatamLike"]) == 0
    assert json.loads(Path("run/metrics.json").read_text())["metrics"] == scores
