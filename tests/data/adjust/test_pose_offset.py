"""Poses and pictures of different times: the path between the poses, and the offset that the pictures tell."""

from typing import Any, cast

import pytest
import torch

from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.data import SequenceError, apply_options, repaired
from gsfusion_nb.data.adjust.poses import PosePath
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.checkup.pose_offset import estimate_pose_offset, offset_of_turns

LATE: dict[str, Any] = {"n_frames": 480, "width": 96, "height": 72, "pose_delay_s": 0.05}

PART = DataConfig(start=150, stop=190, hold_out_every=0)


@pytest.fixture(scope="module")
def late():
    """Forty frames of a walk whose poses are those of 50 ms later: the pictures are 50 ms early."""
    return apply_options(cast(Any, room(**LATE)), PART)


def test_a_path_goes_through_its_poses_and_is_exact_for_even_motion():
    times_s = torch.tensor([0.0, 0.1, 0.2, 0.35, 0.4, 5.0], dtype=torch.float64)
    velocity = torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.9], dtype=torch.float64)
    poses = se3.exp(times_s[:, None] * velocity)
    poses[2] = torch.nan
    path = PosePath(times_s, poses)
    between = torch.tensor([-0.05, 0.03, 0.1, 0.18, 0.38], dtype=torch.float64)
    torch.testing.assert_close(path.at(between), se3.exp(between[:, None] * velocity))
    torch.testing.assert_close(path.at(times_s[-1:] + 0.05), poses[-1:])  # nothing near says how it moves there
    assert bool(path.at(torch.tensor([1.0], dtype=torch.float64)).isnan().all())


def test_a_known_offset_brings_the_true_poses_back(late):
    source = late.source
    mended = repaired(source, RepairConfig(pose_offset_s=-0.05))
    errors = {}
    for name, sequence in (("given", source), ("mended", mended)):
        motion = [se3.motion(sequence.pose(i), source.true_pose(i)) for i in range(40)]
        errors[name] = [sum(x) / 40 for x in zip(*motion, strict=True)]
    assert errors["mended"][0] < errors["given"][0] / 3
    assert errors["mended"][1] < errors["given"][1] / 3
    with pytest.raises(ValueError, match=r"pose_offset_s or repair.pose_shift_frames, not both"):
        RepairConfig(pose_offset_s=0.01, pose_shift_frames=1.0)
    with pytest.raises(ValueError, match=r"repair.pose_offset_s must be between -10 and 10, got 99"):
        RepairConfig(pose_offset_s=99.0)


def test_the_offset_is_found_from_the_pictures(late):
    found = estimate_pose_offset(late)
    assert found.is_sure
    assert found.offset_s == pytest.approx(-0.05, abs=0.005)
    exact = estimate_pose_offset(apply_options(cast(Any, room(**dict(LATE, pose_delay_s=0.0))), PART))
    assert abs(exact.offset_s) < 0.003


class Telling:
    """A sequence that remembers which frames and poses were read."""

    def __init__(self, source):
        self.source, self.read = source, set()
        self.name, self.camera, self.times_s = source.name, source.camera, source.times_s

    def __len__(self):
        return len(self.source)

    def pose(self, i):
        self.read.add(i)
        return self.source.pose(i)

    def __getitem__(self, i):
        self.read.add(i)
        return self.source[i]


def test_only_mapped_frames_speak():
    source = Telling(room(**LATE))
    opened = apply_options(cast(Any, source), DataConfig(start=150, stop=206, hold_out_every=8, hold_out_offset=4))
    assert source.read == set()  # nothing is estimated when a sequence is opened
    found = estimate_pose_offset(opened)
    assert source.read == set(opened.mapping.positions)
    assert found.is_sure
    assert found.offset_s == pytest.approx(-0.05, abs=0.01)


def estimates(*, turn_deg, period_s, pose_deg, recordings=12):
    """Offsets of simulated recordings: true ones, estimates and errors, seconds.

    The camera sways by ``turn_deg`` about three axes with periods from ``period_s`` to three times that, at 30 frames a
    second. Turns between pictures are aligned to 0.03 degrees, poses have ``pose_deg`` of noise of their own.
    """
    generator, times_s = torch.Generator().manual_seed(1), torch.arange(124, dtype=torch.float64) / 30
    places = torch.tensor([(i, i + gap) for gap in (1, 2, 4) for i in range(124 - gap)])

    def noise(n, deg):
        xi = torch.zeros(n, 6, dtype=torch.float64)
        xi[:, 3:] = torch.randn(n, 3, generator=generator, dtype=torch.float64).mul(deg).deg2rad()
        return se3.exp(xi)

    made = []
    for _ in range(recordings):
        period, phase = torch.rand(2, 4, 3, generator=generator, dtype=torch.float64)
        omega, true_s = (
            2 * torch.pi / (period_s * 3**period),
            float(torch.empty(1).uniform_(-0.04, 0.04, generator=generator)),
        )

        def camera(t, omega=omega, phase=phase):
            xi = torch.zeros(len(t), 6, dtype=torch.float64)
            sway = torch.sin(omega * t[:, None, None] + 2 * torch.pi * phase).mean(1)
            xi[:, 3:] = sway.mul(turn_deg).deg2rad()
            return se3.exp(xi)

        T_WC = camera(times_s)
        T_ba = se3.inverse(T_WC[places[:, 1]]) @ T_WC[places[:, 0]] @ noise(len(places), 0.03)
        path = PosePath(times_s, camera(times_s - true_s) @ noise(len(times_s), pose_deg))
        found = offset_of_turns(path, times_s, places, T_ba)
        made.append((true_s, found.offset_s, found.error_s))
    return torch.tensor(made, dtype=torch.float64).T


@pytest.mark.parametrize(
    ("turn_deg", "period_s", "pose_deg", "known"),
    [
        (20.0, 1.5, 0.0, (12, 12)),
        (20.0, 1.5, 0.2, (12, 12)),  # in the poses' own change of velocity is then more noise than motion
        (4.0, 4.0, 0.05, (0, 4)),  # slow: the pictures do not tell it
    ],
)
def test_the_error_of_the_offset_is_honest(turn_deg, period_s, pose_deg, known):
    """The truth lies within two errors; where the camera hardly changes its turning, nothing is said."""
    true_s, offset_s, error_s = estimates(turn_deg=turn_deg, period_s=period_s, pose_deg=pose_deg)
    finite = error_s.isfinite()
    assert known[0] <= int(finite.sum()) <= known[1]
    assert int(((offset_s - true_s).abs() > 2 * error_s)[finite].sum()) <= 1
    assert bool((offset_s[~finite] == 0).all())


def test_without_times_nothing_is_guessed(late):
    class Timeless:
        name, camera, has_poses = late.name, late.camera, True
        __len__, __getitem__, pose = late.__len__, late.__getitem__, late.pose

    with pytest.raises(SequenceError, match="no times"):
        estimate_pose_offset(Timeless())
