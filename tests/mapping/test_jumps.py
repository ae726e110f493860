"""A camera that jumps to a place that the map does not know: it is lost, not put somewhere else."""

import dataclasses

import pytest

from gsfusion_nb.config import DataConfig, replace
from gsfusion_nb.data import open_sequence
from gsfusion_nb.files import BadFrameError
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import get_system, make_mapper


@pytest.mark.ci
@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam"])
def test_a_jump_in_a_real_recording_is_noticed_and_the_way_back_is_found(shared_sequence, system):
    """Frames 16 to 39 are missing; a fit a metre away passes all limits, but looks different."""
    sequence = open_sequence(shared_sequence("redkitchen_mini48"), data=DataConfig(hold_out_every=0)).mapping
    mapper = make_mapper(replace(get_system(system).preset("replica"), tracking__poses="tracked"), device="cpu")
    lost, off_m = [], []
    for k, i in enumerate([*range(16), 40, 42, 30, 28, 26]):
        frame = dataclasses.replace(sequence[i], index=k, timestamp_s=k / 30)
        try:
            mapper.step(frame)
            off_m.append(float(se3.motion(mapper.localiser.poses[-1].double(), frame.T_WC.double())[1]))
        except BadFrameError:
            lost.append(i)
    assert lost == [40, 42]
    assert max(off_m) < 0.06
