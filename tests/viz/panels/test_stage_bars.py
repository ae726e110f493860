"""Bars of a frame's stages, and Amdahl's law under sliders."""

import pytest

from gsfusion_nb.viz.panels.stage_bars import amdahl_panel, stage_bars, stage_means

SECONDS = {"tsdf": 0.05, "optimise": 0.05}


def test_means_leave_out_what_takes_nothing():
    means = stage_means([{"tsdf": 1.0, "tracking": 0.0}, {"tsdf": 3.0, "tracking": 0.0, "seeding": 2.0}])
    assert means == {"tsdf": 2.0, "seeding": 1.0}


def test_the_panel_says_what_amdahl_says():
    panel = amdahl_panel(SECONDS)
    assert ">1.00</b>" in panel.caption.value
    before = panel.picture().copy()
    panel.set(optimise=1000.0)
    assert ">2.00</b>" in panel.caption.value
    assert "stage: tsdf, 100 %" in panel.caption.value
    assert (panel.picture() != before).any()


def test_a_bar_is_as_long_as_its_time():
    picture = stage_bars({"a": {"x": 0.1}, "b": {"x": 0.05}})
    red = (picture == (61, 133, 198)).all(-1)  # the first colour of the palette
    long, short = red[12].sum(), red[12 + 70].sum()
    assert long == pytest.approx(2 * short, abs=3)
