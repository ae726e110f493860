"""Colour edges against depth edges; a shift of colour is not taken for a time offset, nor the other
way round."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.recordings.checkup import check_recording
from gsfusion_nb.recordings.checkup.colour import ColourFit, _speed, fit_colour
from gsfusion_nb.recordings.checkup.edges import colour_contrast, depth_edges
from gsfusion_nb.recordings.checkup.judge_colour import registration_findings
from gsfusion_nb.recordings.checkup.sample import read_sample
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=320,
    height=240,
    fx=300.0,
    fy=300.0,
    cx=160.0,
    cy=120.0,
)


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

    ``speeds`` are pixels per frame, right and down; colour is that of ``lag`` frames later, moved
    by ``shift``.
    """

    name = "pan"
    camera = CAMERA
    has_poses = True

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
        self.speeds = np.asarray(speeds, float)
        self.lag = lag
        self.shift = np.asarray(shift)

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


@pytest.mark.parametrize(
    ("sequence", "verdict", "shift"),
    [
        (Pan(THERE_AND_BACK), "ok", (0, 0)),
        (Pan(THERE_AND_BACK, lag=0.5), "ok", (0, 0)),
        (Pan(THERE_AND_BACK, shift=(8, -6)), "wrong", (8, -6)),
        (
            Pan(ONE_WAY, lag=0.5),
            "unknown",
            (0, 0),
        ),  # in one kind of motion they cannot be told apart
    ],
    ids=["clean", "late", "moved", "late, one way"],
)
def test_a_late_colour_is_not_a_shift(sequence, verdict, shift):
    repair, (space, time) = registration_findings(fit_colour(read_sample(sequence)), CAMERA)
    assert (space.verdict, time.verdict) == (verdict, "ok")
    assert (repair.rgb_shift_x_px, repair.rgb_shift_y_px) == pytest.approx(shift, abs=1.0)


def test_a_late_colour_of_whole_frames_is_a_time():
    repair, (_, time) = registration_findings(
        fit_colour(read_sample(Pan(THERE_AND_BACK, lag=2))), CAMERA
    )
    assert time.verdict == "wrong"
    assert repair.changes == {"rgb_shift_frames": -2}


class OtherHeldOut(Pan):
    """The same, but every 8th picture, which is held out by default, is the next one: the camera
    seems to stand."""

    def __getitem__(self, i):
        frame = super().__getitem__(i)
        return (
            dataclasses.replace(frame, rgb=super().__getitem__(i + 1).rgb) if i % 8 == 4 else frame
        )


@pytest.mark.parametrize("has_poses", [True, False])
def test_no_repair_of_colour_or_depth_is_estimated_from_held_out_pictures(has_poses):
    pan = Pan(THERE_AND_BACK, shift=(8, -6)), OtherHeldOut(THERE_AND_BACK, shift=(8, -6))
    for sequence in pan:
        sequence.has_poses = has_poses
    ours, theirs = (check_recording(sequence, pictures=False) for sequence in pan)
    named = ("registration", "colour time", "depth scale")
    found = [{f.name: f for f in report.findings if f.name in named} for report in (ours, theirs)]
    assert found[0] == found[1]
    assert ours.data.repair.rgb_shift_x_px == theirs.data.repair.rgb_shift_x_px
    if not has_poses:  # with these poses, at one place, a repair is not tried
        assert ours.data.repair.rgb_shift_x_px == pytest.approx(8, abs=1.0)


def test_a_frame_beside_one_that_was_not_read_is_no_slow_one():
    there = {f.place: f for f in read_sample(Pan(ONE_WAY[:28])).frames if f.place % 8 != 4}
    speeds = np.array([_speed(f, there)[0] for f in there.values()])
    assert speeds == pytest.approx(np.full(speeds.shape, -10.0), abs=0.6)


def test_colour_that_lies_nowhere_is_of_other_frames_or_of_another_camera():
    fit = ColourFit(
        shift_px=(0.0, 0.0),
        scale=1.0,
        mirror="none",
        shift_frames=0,
        score=0.1,
        peak=3.0,
        pixel=1.0,
    )
    repair, (finding,) = registration_findings(fit, CAMERA)
    assert finding.verdict == "wrong"
    assert not repair.changes
