"""Likeness of a frame and the model seen from a pose."""

import dataclasses

import pytest
import torch

from gsfusion_nb.tracking import Surface
from gsfusion_nb.tracking.attempt import correlation
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20.0, cy=15.0)


@pytest.fixture
def frame(generator):
    rgb = torch.rand(30, 40, 3, generator=generator)
    return Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=torch.ones(30, 40), camera=CAMERA, T_WC=torch.eye(4))


def surface(rgb, depth_m):
    normal = torch.zeros(30, 40, 3)
    return Surface(depth_m=depth_m, normal_W=normal, camera=CAMERA, T_WC=torch.eye(4), rgb=rgb)


def test_same_picture_is_one_whatever_the_exposure(frame):
    assert correlation(frame, surface(frame.rgb, frame.depth_m)) == pytest.approx(1.0, abs=1e-5)
    assert correlation(frame, surface(0.3 * frame.rgb + 0.2, frame.depth_m)) == pytest.approx(1.0, abs=1e-4)


def test_negative_is_minus_one_and_noise_is_near_zero(frame, generator):
    assert correlation(frame, surface(1 - frame.rgb, frame.depth_m)) == pytest.approx(-1.0, abs=1e-5)
    other = torch.rand(30, 40, 3, generator=generator)
    assert correlation(frame, surface(other, frame.depth_m)) == pytest.approx(0.0, abs=0.15)


def test_only_the_shared_surface_counts(frame):
    rgb, depth_m = frame.rgb.clone(), frame.depth_m.clone()
    rgb[:15], depth_m[:15] = 0.0, 2.0  # another surface in the upper half
    assert correlation(frame, surface(rgb, depth_m)) == pytest.approx(1.0, abs=1e-5)


def test_nothing_to_compare_is_none(frame):
    assert correlation(frame, dataclasses.replace(surface(frame.rgb, frame.depth_m), rgb=None)) is None
    assert correlation(frame, surface(frame.rgb, torch.zeros(30, 40))) is None
    assert correlation(frame, surface(torch.full((30, 40, 3), 0.5), frame.depth_m)) is None
