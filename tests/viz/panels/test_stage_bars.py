"""Bars of a frame's stages, Amdahl's law under sliders, and the strip of keyframes."""

import pytest
import torch

from gsfusion_nb.drawing.curves import PALETTE, rgb_of
from gsfusion_nb.drawing.pictures import LABEL_PX
from gsfusion_nb.optim import Keyframe
from gsfusion_nb.types import Camera
from gsfusion_nb.viz.panels.stage_bars import amdahl_panel, keyframe_strip, stage_bars, stage_means

SECONDS = {"tsdf": 0.05, "optimise": 0.05}


def test_means_leave_out_what_takes_nothing():
    means = stage_means(
        [{"tsdf": 1.0, "tracking": 0.0}, {"tsdf": 3.0, "tracking": 0.0, "seeding": 2.0}]
    )
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
    blue = (picture == (61, 133, 198)).all(-1).sum(1)  # the first colour of the palette
    assert blue[:70].max() == pytest.approx(2 * blue[90:150].max(), abs=3)


def test_shares_make_bars_of_one_length():
    picture = stage_bars({"a": {"x": 0.9, "y": 0.1}, "b": {"x": 0.001, "y": 0.003}}, shares=True)
    blue = (picture == rgb_of(PALETTE[0])).all(-1).sum(1)
    orange = (picture == rgb_of(PALETTE[1])).all(-1).sum(1)
    slow = slice(0, 70)
    fast = slice(90, 150)
    whole = blue[slow].max() + orange[slow].max()
    assert blue[slow].max() == pytest.approx(0.9 * whole, abs=4)
    assert blue[fast].max() == pytest.approx(0.25 * whole, abs=4)
    assert orange[fast].max() == pytest.approx(0.75 * whole, abs=4)


CAMERA = Camera(
    width=128,
    height=96,
    fx=120.0,
    fy=120.0,
    cx=64.0,
    cy=48.0,
)


def keyframes(n):
    shades = [torch.full((96, 128, 3), 5 * k, dtype=torch.uint8) for k in range(n)]
    return [
        Keyframe(index=k, rgb_u8=shade, camera=CAMERA, T_WC=torch.eye(4))
        for k, shade in enumerate(shades)
    ]


def test_pictures_in_rows():
    strip = keyframe_strip(keyframes(5), columns=4, width=400)
    assert strip.shape == (2 * (70 + LABEL_PX), 4 * 94 + 3 * 6, 3)
    assert [int(strip[50, 50 + 100 * k, 0]) for k in range(4)] == [0, 5, 10, 15]
    assert int(strip[150, 50, 0]) == 20
    assert (strip[122:, 100:194] == 255).all()
