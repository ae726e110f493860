"""Colour edges against depth edges; a shift of colour and a time offset, told apart by the speed of the image."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.recordings.checkup.colour import OF_OTHER_FRAMES, ColourEvidence, registration_findings
from gsfusion_nb.recordings.checkup.edges import (
    ColourFit,
    ColourMotion,
    colour_contrast,
    colour_motion,
    depth_edges,
    fit_colour,
    image_speeds,
    line_through,
    moving_together,
)
from gsfusion_nb.recordings.checkup.sample import read_sample
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)


def test_edges_belong_to_the_nearer_side():
    depth_m = np.full((6, 8), 4.0, np.float32)
    depth_m[2:5, 3:6] = 1.0
    expected = np.zeros((6, 8))
    expected[2:5, 3:6] = 1
    expected[3, 4] = 0
    assert np.array_equal(depth_edges(depth_m), expected)


def test_narrow_holes_beside_an_object_are_background():
    depth_m = np.full((1, 30), 4.0, np.float32)
    depth_m[0, 10:15] = 1.0
    depth_m[0, 15:20] = 0.0  # the part that the projector does not reach
    assert np.flatnonzero(depth_edges(depth_m)[0]).tolist() == [10, 14]
    depth_m[0, 15:29] = 0.0  # too wide to know
    assert np.flatnonzero(depth_edges(depth_m)[0]).tolist() == [10]


def test_a_slope_has_no_edges():
    depth_m = np.linspace(1, 3, 100, dtype=np.float32)[None].repeat(5, 0)
    assert depth_edges(depth_m).sum() == 0


def test_contrast_is_the_same_in_weak_light():
    image = np.full((60, 80), 40, np.uint8)
    image[:, 40:] = 200
    contrast = colour_contrast(image, image.shape)
    assert contrast[30, 39:41].min() == pytest.approx(4.0)
    assert contrast[:, :20].max() < 1e-3
    assert np.abs(contrast - colour_contrast(image // 2, image.shape)).max() < 0.6


class Pan:
    """Crops of one large picture of boxes before a wall: what a turning camera sees of a far scene.

    ``speeds`` are pixels per frame, right and down; colour is that of ``lag`` frames later, moved by ``shift``.
    """

    name, camera = "pan", CAMERA

    def __init__(self, speeds, *, lag=0.0, shift=(0, 0)):
        generator = np.random.default_rng(0)
        self.depth = np.full((900, 1500), 4.0, np.float32)
        self.rgb = generator.integers(90, 130, (900, 1500, 3)).astype(np.uint8)
        for _ in range(130):
            x, y, w, h = generator.integers((0, 0, 20, 20), (1400, 800, 90, 90))
            self.depth[y : y + h, x : x + w] = generator.uniform(1.0, 3.0)
            self.rgb[y : y + h, x : x + w] = generator.integers(0, 255, 3)
        self.rgb = cv2.GaussianBlur(self.rgb, (0, 0), 0.7)
        self.at = np.cumsum(np.asarray(speeds, float), axis=0)
        self.at += 400 - self.at.mean(0)
        self.speeds, self.lag, self.shift = np.asarray(speeds, float), lag, np.asarray(shift)

    def __len__(self):
        return len(self.at)

    def pose(self, i):
        return torch.eye(4)

    def __getitem__(self, i):
        x, y = np.rint(self.at[i]).astype(int)
        u, v = np.rint(self.at[i] + self.lag * self.speeds[i] - self.shift).astype(int)
        return Frame(
            index=i,
            timestamp_s=i / 30,
            rgb=torch.from_numpy(self.rgb[v : v + 240, u : u + 320].copy()),
            depth_m=torch.from_numpy(self.depth[y : y + 240, x : x + 320].copy()),
            camera=CAMERA,
            T_WC=torch.eye(4),
        )


THERE_AND_BACK = [(12 * np.sin(i / 5), 4 * np.cos(i / 7)) for i in range(60)]
"""Fast both ways, and slow between."""
ONE_WAY = [(10.0, 1.0)] * 30


@pytest.fixture(scope="module")
def samples():
    """Samples of the same scene, and what was measured of them."""
    made = {
        "late": Pan(THERE_AND_BACK, lag=0.5),
        "moved": Pan(THERE_AND_BACK, shift=(8, -6)),
        "late, one way": Pan(ONE_WAY, lag=0.8),
    }
    read = {name: read_sample(sequence) for name, sequence in made.items()}
    return {name: (sample, colour_motion(sample, image_speeds(sample))) for name, sample in read.items()}


def judged(sample, motion):
    evidence = ColourEvidence(fit=fit_colour(sample), motion=motion, order=None, together=1.0, step_s=0.1)
    repair, findings = registration_findings(evidence, sample.camera)
    return repair, *findings


def test_a_line_through_exact_shifts():
    speeds = np.array([[8.0, 1.0], [-4.0, 0.0], [2.0, -3.0], [0.5, 5.0]])
    constant, lag, _ = line_through(np.array([1.5, -2.0]) + 0.3 * speeds, speeds, np.ones(4))
    assert constant == pytest.approx((1.5, -2.0), abs=0.02)
    assert lag == pytest.approx(0.3, abs=0.01)


def test_a_late_colour_is_a_time_and_not_a_shift(samples):
    sample, motion = samples["late"]
    assert motion.lag_frames == pytest.approx(0.5, abs=0.05)
    repair, space, time = judged(sample, motion)
    assert time.verdict == "doubtful"
    assert "ms) later than depth: over 12 windows" in time.sentence
    assert space.verdict == "ok"
    assert not repair.changes


def test_a_shift_is_no_time(samples):
    sample, motion = samples["moved"]
    repair, space, time = judged(sample, motion)
    assert space.verdict == "wrong"
    assert (repair.rgb_shift_x_px, repair.rgb_shift_y_px) == pytest.approx((8.0, -6.0), abs=1.0)
    assert time.verdict == "ok"


def test_in_one_kind_of_motion_they_cannot_be_told_apart(samples):
    sample, motion = samples["late, one way"]
    assert not motion.separable
    repair, space, time = judged(sample, motion)
    assert space.verdict == time.verdict == "unknown"
    assert "a shift and a time offset look alike" in space.sentence
    assert not repair.changes


def fitted(**changes):
    values = {"shift_px": (0.0, 0.0), "scale": 1.0, "mirror": "none", "shift_frames": 0, "score": 1.0}
    values |= {"score_as_read": 1.0, "peak": 8.0, "pixel": 1.0}
    return ColourFit(**(values | changes))


@pytest.mark.parametrize(
    ("fit", "moved_px", "verdict"),
    [
        ({}, 0.9, "ok"),  # less than edges can be placed
        ({}, 4.0, "doubtful"),
        ({"scale": 0.91}, 4.0, "unknown"),  # edges lie beside those of depth by their place, whatever the time
        ({"mirror": "x"}, 4.0, "unknown"),
    ],
)
def test_a_time_offset_is_only_named_where_edges_show_it(fit, moved_px, verdict):
    motion = ColourMotion(
        shift_px=(0.0, 0.0), shift_error_px=0.1, lag_frames=moved_px / 20, lag_error_frames=0.005, speed_px=20.0,
        windows=12, separable=True,
    )  # fmt: skip
    evidence = ColourEvidence(fit=fitted(**fit), motion=motion, order=None, together=1.0, step_s=0.1)
    _, (_, time) = registration_findings(evidence, CAMERA)
    assert time.name == "colour time"
    assert time.verdict == verdict


def test_colour_moves_with_depth_unless_it_is_of_other_frames(samples):
    sample, _ = samples["late"]
    assert (moving_together(sample, image_speeds(sample)) or 0.0) > 0.8
    grey = [f.grey for f in sample.frames]
    mixed = dataclasses.replace(
        sample, frames=[dataclasses.replace(f, grey=grey[(7 * i + 3) % len(grey)]) for i, f in enumerate(sample.frames)]
    )
    share = moving_together(mixed, image_speeds(mixed))
    assert share is not None
    assert abs(share) < 0.5


@pytest.mark.parametrize(
    ("together", "said"), [(0.95, "is not registered to depth"), (0.1, "do not belong to the depth")]
)
def test_two_cameras_are_not_other_frames(together, said):
    """No shift fits: whether colour moves with depth tells a second camera from wrongly paired images."""
    fit = fitted(score=0.1, score_as_read=0.05, peak=3.0)
    evidence = ColourEvidence(fit=fit, motion=None, order=None, together=together, step_s=0.0)
    repair, (finding,) = registration_findings(evidence, CAMERA)
    assert finding.verdict == "wrong"
    assert said in finding.sentence
    assert (OF_OTHER_FRAMES in finding.numbers) == ("do not belong" in said)  # then exposure is not judged
    assert not repair.changes
