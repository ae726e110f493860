"""The panel that repairs a recording by hand: the true repair makes its two frames agree."""

import re

import pytest

from gsfusion_nb.data import tum
from gsfusion_nb.data.room.hand_held import HandHeld, write_hand_held
from gsfusion_nb.viz import repair_panel


def agreeing(panel) -> int:
    return int(re.findall(r"<b>(\d+)%</b>", panel.caption.value)[0])


def test_the_true_repair_is_the_best(tmp_path):
    made = HandHeld(n_images=8, width=48, height=36, noise="none", images_per_walk=300)
    recording = tum(write_hand_held(tmp_path / "hand_held", made), camera=made.camera)
    panel = repair_panel(recording, 0, 2)
    as_read = agreeing(panel)
    panel.set(depth_factor=5.0, pose_shift=1.5)
    assert agreeing(panel) > max(70, as_read + 30)
    picture = panel.picture()
    panel.set(right_px=5.0, down_px=-3.0)
    assert (panel.picture() != picture).any()
    with pytest.raises(IndexError, match="second must be below"):
        repair_panel(recording, 0, 99)
