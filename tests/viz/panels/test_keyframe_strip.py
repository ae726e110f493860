"""The strip of keyframes: so many pictures, in order, evenly spread when there are too many."""

import torch

from gsfusion_nb.optim import Keyframe
from gsfusion_nb.types import Camera
from gsfusion_nb.viz.panels.stage_bars import keyframe_strip

CAMERA = Camera(width=128, height=96, fx=120.0, fy=120.0, cx=64.0, cy=48.0)


def keyframes(n):
    shades = [torch.full((96, 128, 3), 5 * k, dtype=torch.uint8) for k in range(n)]
    return [Keyframe(index=k, rgb_u8=shade, camera=CAMERA, T_WC=torch.eye(4)) for k, shade in enumerate(shades)]


def test_pictures_in_rows():
    strip = keyframe_strip(keyframes(5), columns=4, width=400)
    height = strip.shape[0] // 2
    assert strip.shape == (2 * height, 400, 3)
    assert [int(strip[10, 50 + 100 * k, 0]) for k in range(4)] == [0, 5, 10, 15]
    assert int(strip[height + 10, 50, 0]) == 20
    assert (strip[height:, 100:] == 255).all()


def test_many_are_thinned_and_none_is_white():
    strip = keyframe_strip(keyframes(50), columns=5, width=250, most=5)
    assert [int(strip[10, 25 + 50 * k, 0]) for k in range(5)] == [0, 60, 120, 185, 245]
    assert (keyframe_strip([], width=100) == 255).all()
