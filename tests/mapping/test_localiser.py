"""What the localiser remembers of the frames that it tracked."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import DataConfig, LandmarkConfig, TrackingConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping.localiser import Localiser


@pytest.mark.parametrize(("enabled", "kept"), [(False, "database"), (True, "map")])
def test_landmarks_are_made_only_where_they_are_used(enabled, kept):
    config = TrackingConfig(poses="tracked", landmarks=LandmarkConfig(enabled=enabled))
    mapping = open_sequence("room", data=DataConfig(width=320, height=240)).mapping
    localiser, again = Localiser(config), Localiser(config)
    frames = [mapping[i] for i in (0, 12, 24)]
    for frame in frames:
        localiser.record(frame)
    state = localiser.state_dict()
    assert [name for name in ("back_end", "map", "database") if state[name] is not None] == [kept]
    again.load_state_dict(state)
    assert again.camera == localiser.camera == frames[0].camera
    keyframes = again.state_dict()[kept]
    keyframes = keyframes["database"] if enabled else keyframes
    torch.testing.assert_close(keyframes, state[kept]["database"] if enabled else state[kept])
    found = again._relocalise(dataclasses.replace(frames[1], T_WC=torch.eye(4)))
    assert min(float((T[:3, 3] - frames[1].T_WC[:3, 3]).norm()) for T in found) < 0.05
