"""Both systems track with the back end through a loop that must close, and find themselves again after a loss."""

import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gsfusion, rtg_slam
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import RTGSLAM, GSFusion

pytest.importorskip("gtsam", reason="the extra 'slam' is not installed")

BACK_END = {"enabled": True, "loop_min_gap": 3, "keyframe_rotation_deg": 4.0, "correct_from_m": 0.0}
TRACKING = {"poses": "tracked", "landmarks": {"enabled": True}, "back_end": BACK_END}


@pytest.fixture(scope="module")
def there_and_back():
    """Eight frames of a fast walk, and the same views on the way back."""
    sequence = room(n_frames=240, width=160, height=120)
    there = [sequence[i] for i in range(8)]
    back = [dataclasses.replace(f, index=15 - f.index) for f in reversed(there)]
    return [dataclasses.replace(f, timestamp_s=0.1 * f.index) for f in (*there, *back)]


def mapper_of(system: str) -> Any:
    if system == "gsfusion":
        return GSFusion(gsfusion("room", tracking=TRACKING, tsdf__voxel_size_m=0.04))
    return RTGSLAM(rtg_slam("room", tracking=TRACKING, window__iterations=4, keyframes__iterations=2))


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam"])
def test_a_loop_closes_and_a_loss_is_overcome(there_and_back, system):
    """After the way back the camera is covered, then shown another part of the way, half a metre away."""
    mapper = mapper_of(system)
    for frame in there_and_back:
        mapper.step(frame)
    localiser = mapper.localiser
    back_end = localiser._back_end
    closed = [(back_end.database.index[e.j], back_end.database.index[e.i]) for e in back_end.edges if e.kind == "loop"]
    assert any(late >= 11 and early <= 4 for late, early in closed)
    true = torch.stack([f.T_WC for f in there_and_back]).double()
    assert ate_rmse(torch.stack(localiser.poses).double(), true) < 0.01

    last, far = there_and_back[-1], there_and_back[6]
    covered = dataclasses.replace(last, index=16, timestamp_s=1.6, depth_m=torch.zeros_like(last.depth_m))
    with pytest.raises(BadFrameError, match="frame 16 cannot be mapped"):
        mapper.step(covered)
    mapper.step(dataclasses.replace(far, index=17, timestamp_s=1.7))
    degrees, metres = se3.motion(localiser.poses[-1], far.T_WC)
    assert metres < 0.02
    assert degrees < 0.5
