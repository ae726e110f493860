"""What the check says of exposure, by how much the brightness of the same points differs."""

import numpy as np
import pytest

from gsfusion_nb.recordings.checkup.frame_to_frame import OverFrames
from gsfusion_nb.recordings.checkup.judge_frames import exposure_finding


@pytest.mark.parametrize(
    ("step", "spread", "verdict", "fit"),
    [(0.02, 0.1, "ok", False), (0.1, 0.2, "ok", True), (0.1, 1.2, "doubtful", True), (0.4, 0.4, "doubtful", True)],
)
def test_fitting_exposures_is_advised_where_it_pays(step, spread, verdict, fit):
    nan = np.full(3, np.nan)
    same = np.zeros(3, bool)
    over = OverFrames(
        number=np.arange(3), error=nan, turned_deg=nan, moved_m=nan, gain_stops=np.array([0.0, -step, np.nan]),
        flow_px=nan, sharpness=nan, missing=nan, brightness=nan, same_colour=same, same_depth=same,
    )  # fmt: skip
    finding = exposure_finding(over, np.array([np.nan, spread, -0.05]))
    assert finding.verdict == verdict
    assert ("--optim.fit-exposure" in finding.sentence + finding.repair) == fit
    assert finding.numbers == {"largest_step_stops": pytest.approx(step), "largest_difference_stops": spread}
