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
    return TracePanel(trace), run.mapper


def test_a_panel_shows_every_moment_and_follows_clicks(panel):
    panel, _ = panel
    assert panel.story.u == 24
    first = panel.picture()
    assert first.shape == (330, 440, 3)
    n = len(panel.story.moments)
    assert panel.slider.max == n - 1
    for k in (1, n - 1):
        panel.go_to(k)
        assert panel.story.moments[k].title in panel.numbers.value
        assert "gsfusion_nb/" in panel.numbers.value
    assert panel.next.disabled
    panel.back.click()
    assert panel.slider.value == n - 2
    panel.follows = "Gaussian"
    panel.clicks.pixel = (30, 20)
    step = panel.story.moments[panel.slider.value]
    assert panel.story.id >= 0
    assert (panel.picture() != first).any()
    assert str(panel.story.id) in panel.numbers.value
    assert step.title in panel.clicks.alt
    panel.follows = "voxel"
    panel.clicks.pixel = (10, 11)
    assert len(panel.story.ijk) == 3
    assert abs(panel.story.moments[0].z_m - 2.0) < 0.1
    text = panel._repr_mimebundle_()[0]["text/plain"]
    assert "voxel" in text


def test_a_click_in_the_splat_viewer_follows_that_gaussian(panel):
    panel, mapper = panel
    viewer = SplatViewer(mapper, width=64, height=48)
    panel.follow_picks(viewer)
    viewer.picked = 5
    assert panel.story.row == 5
    assert panel.story.birth.rule == "gsfusion"
    assert any(np.any(panel.go_to(k).picture()) for k in range(3))
