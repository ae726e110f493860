"""Single findings: what files say before frames are made of them; the brightness of the same
points."""

import dataclasses
import math
import re
import shutil
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.data import folder
from gsfusion_nb.data.adjust.small_images import without_speckle
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.checkup import check_recording
from gsfusion_nb.recordings.checkup.frames import OverFrames, exposure_finding
from gsfusion_nb.recordings.checkup.report import Finding
from gsfusion_nb.recordings.checkup.sample import read_sample
from gsfusion_nb.recordings.checkup.stored_values import (
    image_size,
    missing_finding,
    pose_matrices,
    time_stamps,
)
from gsfusion_nb.recordings.checkup.trial import Trial, Trials


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


def test_times_that_count_frames_are_doubted(broken, tmp_path, caplog):
    recording, _ = broken("small room", "clean")
    root = tmp_path / "counted"
    shutil.copytree(recording.root, root)
    names = [path.stem for path in sorted((root / "rgb").iterdir())]
    (root / "times.txt").write_text("".join(f"{name} {i}\n" for i, name in enumerate(names)))
    (finding,) = time_stamps(folder(root))
    assert finding.verdict == "doubtful"
    assert "one frame in 1 s, but they are whole numbers" in finding.sentence
    assert finding.repair == "if they number the frames: --reader times=false"
    assert "if they number the frames: --reader times=false" in caplog.text
    caplog.clear()
    sequence = folder(root, times=False)
    assert time_stamps(sequence)[0].verdict == "unknown"
    assert sequence.timestamps_s[:3] == [0, 1 / 30, 2 / 30]
    assert not caplog.text


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
        assert (
            time_stamps(dataclasses.replace(sequence, timestamps_s=changed))[0].verdict == verdict
        )


@pytest.mark.parametrize(
    ("step", "spread", "verdict", "fit"),
    [
        (0.02, 0.1, "ok", False),
        (0.1, 0.2, "ok", True),
        (0.1, 1.2, "doubtful", True),
        (0.4, 0.4, "doubtful", True),
    ],
)
def test_fitting_exposures_is_advised_where_it_pays(step, spread, verdict, fit):
    nan = np.full(3, np.nan)
    same = np.zeros(3, bool)
    over = OverFrames(
        number=np.arange(3),
        error=nan,
        turned_deg=nan,
        moved_m=nan,
        gain_stops=np.array([0.0, -step, np.nan]),
        sharpness=nan,
        missing=nan,
        same=same,
    )
    finding = exposure_finding(over, np.array([np.nan, spread, -0.05]))
    assert finding.verdict == verdict
    assert ("--optim.fit-exposure" in finding.sentence + finding.repair) == fit


class Speckled:
    """Frames of the built-in room with single pixels of depth missing everywhere, ten times too
    far."""

    def __init__(self, valid: float):
        source = room(n_frames=120, width=160, height=120)
        self.frames = [source[2 * i] for i in range(8)]
        self.valid = valid
        self.camera = self.frames[0].camera
        self.name = "speckled"

    def __len__(self):
        return len(self.frames)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i):
        there = torch.rand(120, 160, generator=torch.Generator().manual_seed(i)) < self.valid
        return dataclasses.replace(
            self.frames[i],
            index=i,
            depth_m=10 * self.frames[i].depth_m * there,
        )

    def pose(self, i):
        return self.frames[i].T_WC


@pytest.mark.parametrize("valid", [0.5, 0.3])
def test_the_unit_of_speckled_depth_is_found(valid):
    report = check_recording(Speckled(valid), pictures=False)
    findings = {finding.name: finding for finding in report.findings}
    assert report.data.repair.depth_factor == pytest.approx(0.1, rel=0.02)
    assert findings["depth scale"].verdict == "wrong"
    assert findings["registration"].verdict in ("ok", "unknown")
    assert f"{1 - valid:.0%} of the pixels have no depth" in findings["depth coverage"].sentence


def test_only_speckle_is_filled(generator):
    slope = torch.linspace(1.0, 2.0, 64).expand(48, 64).contiguous()
    speckled = slope * (torch.rand(48, 64, generator=generator) < 0.5)
    filled = without_speckle(speckled.numpy())
    assert (filled > 0).mean() > 0.99
    # two columns of the slope, and a little
    assert np.abs(filled - slope.numpy())[filled > 0].max() < 0.04
    assert np.array_equal(filled[speckled > 0], speckled[speckled > 0])
    with_hole = slope.clone()
    with_hole[10:30, 20:40] = 0
    assert np.array_equal(without_speckle(with_hole.numpy()), with_hole.numpy())
    assert not without_speckle(np.zeros((8, 8), np.float32)).any()


@pytest.mark.parametrize(
    ("factor", "verdict", "options"),
    [
        (1.0, "ok", []),
        (3.0, "doubtful", ["--tsdf.far-m"]),
        (20.0, "doubtful", ["--tsdf.far-m", "--tsdf.voxel-size-m"]),
        (0.2, "doubtful", ["--tsdf.near-m"]),
        (0.04, "doubtful", ["--tsdf.near-m", "--tsdf.voxel-size-m"]),
    ],
)
def test_depth_outside_of_the_mapped_range_is_told(factor, verdict, options):
    """A hall, a street, a close-up and what an endoscope sees: in order as they are, but not mapped
    by default."""
    frames = [
        dataclasses.replace(f, depth_m=factor * f.depth_m)
        for f in read_sample(Speckled(1.0)).frames
    ]
    finding = missing_finding(frames, depth_factor=0.1)
    assert finding.verdict == verdict
    assert re.findall(r"--[\w.-]+", finding.repair) == options


def test_what_was_not_measured_is_no_reason_against_a_repair():
    unknown = Trial(share=math.nan, contrast=1.0)
    some = Trial(share=0.5, contrast=1.0)
    assert unknown.gains(some)
    assert some.gains(unknown)
    assert "too few points meet a depth" in some.beside(unknown)
    assert not some.gains(some)
    assert not Trial(share=0.5004, contrast=1.0).gains(some)  # 50.0 % -> 50.0 %
    assert Trial(share=0.502, contrast=1.0).gains(some)


def test_what_gains_nothing_is_not_said_to_be_wrong(monkeypatch):
    base: Any = room(n_frames=200, width=32, height=24)
    trials = Trials(base, DataConfig())
    monkeypatch.setattr(
        trials,
        "of",
        lambda *_, **__: Trial(share=0.499, contrast=1.0),
    )
    found = [
        Finding(
            "focal length",
            "wrong",
            "The focal lengths are wrong: fx 500.0, but ...",
            "--data.repair.fx 520.0",
        ),
        Finding(
            "frozen frames",
            "wrong",
            "Colour or depth is that of the previous frame.",
            "--data.repair.skip 3",
        ),
    ]
    more = DataConfig(repair=RepairConfig(fx=520.0, skip=(3,)))
    (focal, frozen), kept, _ = trials.judged(found, more, None)
    assert kept == DataConfig()
    assert (focal.verdict, focal.repair, frozen.verdict, frozen.repair) == (
        "unknown",
        "",
        "unknown",
        "",
    )
    assert focal.sentence == (
        "Cannot be known from these frames: --data.repair.fx 520.0 was tried, and is no better: "
        "49.9% -> 49.9% of the "
        "points agree in depth and brightness, contrast on depth edges 1.00 -> 1.00."
    )
    assert frozen.sentence.startswith(
        "Colour or depth is that of the previous frame. Tried, and no better: 49.9%"
    )
