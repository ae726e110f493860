"""Single findings: what files say before frames are made of them; the brightness of the same points."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import RepairConfig
from gsfusion_nb.data import folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.checkup.frames import OverFrames, exposure_finding
from gsfusion_nb.recordings.checkup.stored_values import image_size, pose_matrices, time_stamps


@pytest.fixture
def poses(generator):
    """Ten rigid transforms."""
    return se3.exp(torch.randn(10, 6, generator=generator, dtype=torch.float64))


def test_depth_of_another_view_has_no_repair_by_size(tmp_path, box):
    root = box.folder(tmp_path, n=2)
    for file in (root / "depth").iterdir():
        cv2.imwrite(str(file), np.full((48, 48), 1000, np.uint16))
    repair, finding = image_size(folder(root))
    assert repair == RepairConfig()
    assert finding.verdict == "wrong"
    assert "other proportions, so they are not one view" in finding.sentence


def test_rigid_matrices_are_left_alone(poses):
    repair, finding = pose_matrices(poses)
    assert repair == RepairConfig()
    assert finding.verdict == "ok"


def test_what_makes_matrices_rigid(poses):
    scaled = poses.clone()
    scaled[:, :3, :3] *= 0.5
    rough = poses + 0.01 * torch.eye(4, dtype=torch.float64)[[1, 0, 2, 3]]
    rough[:, 3] = poses[:, 3]
    for stored, changes in (
        (poses.transpose(1, 2), {"matrices": "column_major"}),
        (scaled, {"nearest_rotation": True}),
        (rough, {"nearest_rotation": True}),
        (scaled.transpose(1, 2), {"matrices": "column_major", "nearest_rotation": True}),
    ):
        repair, finding = pose_matrices(stored)
        assert repair.changes == changes
        assert finding.verdict == "wrong"
        assert finding.repair == repair.flags


def test_what_nothing_makes_rigid(poses):
    mirrored = poses @ torch.diag(torch.tensor([1.0, 1, -1, 1], dtype=torch.float64))
    repair, finding = pose_matrices(mirrored)
    assert repair == RepairConfig()
    assert finding.verdict == "doubtful"
    poses[2:4] = torch.nan
    _, finding = pose_matrices(poses)
    assert finding.verdict == "doubtful"
    assert pose_matrices(torch.full((3, 4, 4), torch.nan))[1].verdict == "wrong"


def test_times(broken):
    recording, _ = broken("small room", "clean")
    sequence = folder(recording.root)
    assert time_stamps(sequence)[0].verdict == "unknown"
    sequence = dataclasses.replace(sequence, no_times="")
    times = list(sequence.timestamps_s)
    for changed, verdict in (
        (times, "ok"),
        (times[:10] + [t + 1 for t in times[10:]], "doubtful"),
        ([*times[:5], *times[4:-1]], "wrong"),
    ):
        assert time_stamps(dataclasses.replace(sequence, timestamps_s=changed))[0].verdict == verdict


@pytest.mark.parametrize(
    ("step", "spread", "verdict", "fit"),
    [(0.02, 0.1, "ok", False), (0.1, 0.2, "ok", True), (0.1, 1.2, "doubtful", True), (0.4, 0.4, "doubtful", True)],
)
def test_fitting_exposures_is_advised_where_it_pays(step, spread, verdict, fit):
    nan = np.full(3, np.nan)
    same = np.zeros(3, bool)
    over = OverFrames(
        number=np.arange(3), error=nan, turned_deg=nan, moved_m=nan, gain_stops=np.array([0.0, -step, np.nan]),
        sharpness=nan, missing=nan, same=same,
    )  # fmt: skip
    finding = exposure_finding(over, np.array([np.nan, spread, -0.05]))
    assert finding.verdict == verdict
    assert ("--optim.fit-exposure" in finding.sentence + finding.repair) == fit
