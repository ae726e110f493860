"""Steps from frame to frame: what proves that an image is repeated, and which poses jump."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data.adjust.steps import find_jumps, repeated_image
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=8,
    height=6,
    fx=8.0,
    fy=8.0,
    cx=4.0,
    cy=3.0,
)


def frame_of(index, *, colour, depth_m):
    return Frame(
        index=index,
        timestamp_s=0.0,
        rgb=colour,
        depth_m=depth_m,
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ((False, False), ""),
        ((True, False), "colour"),
        ((False, True), "depth"),
        ((True, True), "colour and depth"),
    ],
)
def test_repeated_images_are_named(generator, what, expected):
    colours = torch.rand(2, 6, 8, 3, generator=generator)
    depths = torch.rand(2, 6, 8, generator=generator) + 1
    a = frame_of(0, colour=colours[0], depth_m=depths[0])
    b = frame_of(
        1,
        colour=colours[0 if what[0] else 1],
        depth_m=depths[0 if what[1] else 1],
    )
    assert repeated_image(a, b) == expected


def test_images_of_one_value_prove_nothing(generator):
    red = torch.tensor([0.8, 0.1, 0.1]).expand(6, 8, 3).clone()
    wall = torch.full((6, 8), 2.0)
    assert (
        repeated_image(
            frame_of(0, colour=red, depth_m=wall),
            frame_of(1, colour=red, depth_m=wall),
        )
        == ""
    )
    none = torch.zeros(6, 8)
    assert (
        repeated_image(
            frame_of(0, colour=red, depth_m=none),
            frame_of(1, colour=red, depth_m=none),
        )
        == ""
    )


def steps(**changes):
    """Twenty steps of 2 degrees and 4 cm in which depth differs by 0.3 per cent, some of them
    changed."""
    values = {
        "turned_deg": np.full(20, 2.0),
        "moved_m": np.full(20, 0.04),
        "error": np.full(20, 0.003),
    }
    for name, (rows, value) in changes.items():
        values[name][rows] = value
    return values | {"frozen": np.zeros(20, bool)}


@pytest.mark.parametrize(
    ("changes", "jumps"),
    [
        ({}, set()),
        ({"moved_m": (9, 1.7), "error": (9, 0.3)}, {9}),
        ({"moved_m": (9, 1.7), "error": (9, np.nan)}, {9}),
        ({"moved_m": (9, 1.7)}, set()),  # depth confirms it
        ({"error": (9, 0.3)}, set()),  # no longer than its neighbours
        ({"moved_m": (9, 0.1), "error": (9, np.nan)}, set()),  # fast, and nothing in common
        ({"turned_deg": ([9, 10], 40.0), "error": ([9, 10], 0.2)}, {9, 10}),
    ],
)
def test_a_jump_is_a_long_step_that_depth_does_not_confirm(changes, jumps):
    assert find_jumps(**steps(**changes)) == jumps


def test_beside_a_repeated_image_no_step_is_judged():
    values = steps(moved_m=(9, 1.7), error=(9, 0.3))
    values["frozen"][9] = True
    assert find_jumps(**values) == set()


def test_a_step_below_what_a_hand_does_is_no_jump():
    """Half a degree and 2 cm where the camera nearly stands still."""
    values = steps(error=(9, 0.3))
    values["turned_deg"][:] = 0.01
    values["moved_m"][:] = 0.001
    values["moved_m"][9] = 0.02
    assert find_jumps(**values) == set()
    values["moved_m"][9] = 0.04
    assert find_jumps(**values) == {9}


def test_as_many_steps_after_a_jump_as_before_it_are_compared():
    """At the first step ten others follow: with the last of them the median is 6 cm, without it
    3 cm."""
    values = steps(error=(0, 0.3))
    values["turned_deg"][:] = 0.0
    values["moved_m"][:] = 0.03
    values["moved_m"][0] = 0.08
    values["moved_m"][6:11] = 0.06
    assert find_jumps(**values) == set()
    values["moved_m"][10] = 0.03
    assert find_jumps(**values) == {0}
