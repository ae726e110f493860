"""The panel of a trace: what it shows, what a click follows."""

import numpy as np
import pytest

from gsfusion_nb.course.trace import Trace
from gsfusion_nb.viz import SplatViewer, TracePanel


@pytest.fixture
def panel(make_run):
    """The panel of the trace of two frames, and its mapper."""
    run = make_run(n=2)
    trace = Trace(run.mapper)
    steps = run.online()
    for _ in range(2):
        next(steps)
    return TracePanel(trace, gaussian=0), run.mapper


def test_a_panel_shows_every_moment_and_follows_clicks(panel):
    panel, _ = panel
    assert panel.story.row == 0
    first = panel.picture()
    assert first.shape == (330, 440, 3)
    n = len(panel.story.moments)
    assert panel.controls["moment"].max == n - 1
    for k in (1, n - 1):
        panel.go_to(k)
        assert panel.story.moments[k].title in panel.caption.value
        assert "gsfusion_nb/" in panel.caption.value
    panel.press("Previous")
    assert panel.moment == n - 2
    panel.drag((30.5 * 440 / 48, 20.5 * 440 / 48))
    assert panel.story.id >= 0
    assert (panel.picture() != first).any()
    assert str(panel.story.id) in panel.caption.value
    assert panel.story.moments[panel.moment].title in panel.image.alt
    panel.set(follows="voxel").drag((10.5 * 440 / 48, 11.5 * 440 / 48))
    assert len(panel.story.ijk) == 3
    assert abs(panel.story.moments[0].z_m - 2.0) < 0.1
    assert "voxel" in panel.caption.value
    with pytest.raises(ValueError, match="give one of"):
        panel.look_at(pixel=(3, 4))


def test_a_click_in_the_splat_viewer_follows_that_gaussian(panel):
    panel, mapper = panel
    viewer = SplatViewer(mapper, width=64, height=48)
    panel.follow_picks(viewer)
    viewer.picked = 5
    assert panel.story.row == 5
    assert panel.story.birth.rule == "gsfusion"
    assert any(np.any(panel.go_to(k).picture()) for k in range(3))
