"""Poses and pictures of different times: the repair by a known offset."""

from typing import Any, cast

import pytest

from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.data import apply_options, repaired
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import se3

LATE: dict[str, Any] = {"n_frames": 480, "width": 96, "height": 72, "pose_delay_s": 0.05}

PART = DataConfig(start=150, stop=190, hold_out_every=0)


@pytest.fixture(scope="module")
def late():
    """Forty frames of a walk whose poses are those of 50 ms later: the pictures are 50 ms early."""
    return apply_options(cast(Any, room(**LATE)), PART)


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
    with pytest.raises(
        ValueError, match=r"repair.pose_offset_s must be between -10 and 10, got 99"
    ):
        RepairConfig(pose_offset_s=99.0)
