"""Likeness of a frame and the model seen from a pose."""

import dataclasses
import inspect
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import gsfusion_nb.tracking.attempt as attempt
from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import Surface
from gsfusion_nb.tracking.attempt import (
    CLEARLY_BETTER,
    WIDE_ANGLE_DEG,
    WIDE_DISTANCE,
    best_of,
    correlation,
    why_too_far,
)
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=40,
    height=30,
    fx=40.0,
    fy=40.0,
    cx=20.0,
    cy=15.0,
)


@pytest.fixture
def frame(generator):
    rgb = torch.rand(30, 40, 3, generator=generator)
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.ones(30, 40),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def surface(rgb, depth_m):
    normal = torch.zeros(30, 40, 3)
    return Surface(
        depth_m=depth_m,
        normal_W=normal,
        camera=CAMERA,
        T_WC=torch.eye(4),
        rgb=rgb,
    )


def test_same_picture_is_one_whatever_the_exposure(frame):
    assert correlation(frame, surface(frame.rgb, frame.depth_m)) == pytest.approx(1.0, abs=1e-5)
    assert correlation(frame, surface(0.3 * frame.rgb + 0.2, frame.depth_m)) == pytest.approx(
        1.0, abs=1e-4
    )


def test_negative_is_minus_one_and_noise_is_near_zero(frame, generator):
    assert correlation(frame, surface(1 - frame.rgb, frame.depth_m)) == pytest.approx(
        -1.0, abs=1e-5
    )
    other = torch.rand(30, 40, 3, generator=generator)
    assert correlation(frame, surface(other, frame.depth_m)) == pytest.approx(0.0, abs=0.15)


def test_only_the_shared_surface_counts(frame):
    rgb = frame.rgb.clone()
    depth_m = frame.depth_m.clone()
    rgb[:15] = 0.0  # another surface in the upper half
    depth_m[:15] = 2.0
    assert correlation(frame, surface(rgb, depth_m)) == pytest.approx(1.0, abs=1e-5)


def test_nothing_to_compare_is_none(frame):
    assert (
        correlation(frame, dataclasses.replace(surface(frame.rgb, frame.depth_m), rgb=None)) is None
    )
    assert correlation(frame, surface(frame.rgb, torch.zeros(30, 40))) is None
    assert (
        correlation(
            frame,
            surface(torch.full((30, 40, 3), 0.5), frame.depth_m),
        )
        is None
    )


def test_a_wide_start_uses_coarse_levels_with_more_steps_and_wide_limits():
    config = TrackingConfig(
        pyramid=(4, 2, 1),
        iterations=(4, 5, 10),
        max_distance_m=0.1,
        max_angle_deg=20.0,
    )
    wide = attempt._widened(config)
    assert (wide.pyramid, wide.iterations) == ((4, 2), (16, 20))
    assert wide.max_distance_m == pytest.approx(0.1 * WIDE_DISTANCE)
    assert wide.max_angle_deg == WIDE_ANGLE_DEG
    one = attempt._widened(
        TrackingConfig(
            pyramid=(2,),
            iterations=(3,),
            max_angle_deg=70.0,
        )
    )
    assert (one.pyramid, one.iterations, one.max_angle_deg) == ((2,), (12,), 70.0)


BEST = {
    "only one": ([1.0], 0),
    "a little better": ([1.0, CLEARLY_BETTER + 0.01], 0),
    "clearly better": ([1.0, CLEARLY_BETTER - 0.01], 1),
    "the best of several": ([1.0, 0.8, 0.5, 0.6], 2),
    "the first of two equal ones": ([1.0, 0.5, 0.5], 1),
    "none": ([1.0, 2.0, 3.0], 0),
}


@pytest.mark.parametrize(("costs", "best"), BEST.values(), ids=BEST)
def test_another_fit_is_taken_only_if_it_is_clearly_better(monkeypatch, costs, best):
    fits: Any = [SimpleNamespace(result=value) for value in costs]
    monkeypatch.setattr(attempt, "cost", lambda sight, result, against, config: result)
    unchecked: Any = inspect.unwrap(best_of)  # these are no attempts
    assert unchecked(None, fits, TrackingConfig()) is fits[best]


@pytest.mark.parametrize("frames", [1, 3])
def test_a_camera_may_have_moved_farther_the_longer_it_was_lost(frames):
    config = TrackingConfig(max_step_m=0.2, max_step_deg=10.0)
    last = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.3, 0.2, 0.1]).double())

    def far(share_m, share_deg):
        turn = torch.tensor([0, 0, 0, 0, math.radians(10.0 * frames * share_deg), 0]).double()
        step = se3.exp(turn)
        step[:3, 3] = torch.tensor([0.0, 0.0, 0.2 * frames * share_m])
        return why_too_far(last, last @ step, config, frames=frames)

    assert far(0.99, 0.99) == ""
    assert f"at most {0.2 * frames:g} m" in far(1.01, 0.0)
    assert f"{10 * frames:g} degrees" in far(0.0, 1.01)
