"""A camera that jumps to a place that the map does not know: it is lost, not put somewhere else."""

import dataclasses
import math
from typing import Any

import pytest
import torch

from gsfusion_nb.config import DataConfig, replace
from gsfusion_nb.data import open_sequence
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import get_system, make_mapper
from gsfusion_nb.mapping.pose_jumps import (
    FARTHEST_STEP_DEG,
    FARTHEST_STEP_M,
    FASTEST_DEG_S,
    FASTEST_M_S,
    jump_from,
)
from gsfusion_nb.types import Camera, Frame


@pytest.mark.ci
@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam"])
def test_a_jump_in_a_real_recording_is_noticed_and_the_way_back_is_found(shared_sequence, system):
    """Frames 16 to 39 are missing; a fit a metre away passes all limits, but looks different."""
    sequence = open_sequence(
        shared_sequence("redkitchen_mini48"), data=DataConfig(hold_out_every=0)
    ).mapping
    mapper = make_mapper(
        replace(get_system(system).preset("replica"), tracking__poses="tracked"), device="cpu"
    )
    lost = []
    off_m = []
    for k, i in enumerate([*range(16), 40, 42, 30, 28, 26]):
        frame = dataclasses.replace(sequence[i], index=k, timestamp_s=k / 30)
        try:
            mapper.step(frame)
            off_m.append(
                float(se3.motion(mapper.trajectory.poses[-1].double(), frame.T_WC.double())[1])
            )
        except BadFrameError:
            lost.append(i)
    assert lost == [40, 42]
    assert max(off_m) < 0.06


FAR = [
    # seconds and frames since the stand; how far the camera may have moved and turned
    (0.01, 1, FARTHEST_STEP_M, FARTHEST_STEP_DEG),
    (0.01, 4, 4 * FARTHEST_STEP_M, 4 * FARTHEST_STEP_DEG),
    (100.0, 1, 100 * FASTEST_M_S, 100 * FASTEST_DEG_S),
]


@pytest.mark.parametrize(("seconds", "frames", "most_m", "most_deg"), FAR)
def test_what_a_camera_can_move_grows_with_frames_and_with_time(seconds, frames, most_m, most_deg):
    stand = {"index": 7, "timestamp_s": 100.0, "T_WC": torch.eye(4)}
    camera = Camera(
        width=2,
        height=2,
        fx=1.0,
        fy=1.0,
        cx=1.0,
        cy=1.0,
    )

    def said(moved_m, turned_deg, at=100.0 + seconds):
        xi = torch.tensor([0.0, 0.0, 0.0, 0.0, math.radians(turned_deg), 0.0])
        T_WC = se3.exp(xi)
        T_WC[0, 3] = moved_m
        images: dict[str, Any] = {"rgb": torch.zeros(2, 2, 3), "depth_m": torch.ones(2, 2)}
        return jump_from(
            stand,
            Frame(index=7 + frames, timestamp_s=at, camera=camera, T_WC=T_WC, **images),
        )

    assert said(0.99 * most_m, 0.0) == ""
    assert f"{1.01 * most_m:.3g} m" in said(1.01 * most_m, 0.0)
    if most_deg < 175:
        assert said(0.0, 0.99 * most_deg) == ""
        assert "degrees" in said(0.0, 1.01 * most_deg)
    # a clock that goes back counts no time
    assert said(0.99 * frames * FARTHEST_STEP_M, 0.0, at=50.0) == ""
