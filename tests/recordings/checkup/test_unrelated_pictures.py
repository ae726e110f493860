"""Pictures of other frames are seen by their brightness where the edges of depth stay in place."""

import dataclasses
import math
from typing import Any

import pytest

from gsfusion_nb.data.adjust.first_frames import SmallFrame, agreement_of, colour_difference
from gsfusion_nb.data.room import room
from gsfusion_nb.recordings.checkup.judge_colour import unrelated_pictures
from gsfusion_nb.recordings.checkup.sample import read_sample


@pytest.fixture(scope="module")
def sample():
    """Frames of a slow walk through the room."""
    walk: Any = room(n_frames=300, width=160, height=120)
    return read_sample(walk, at=list(range(20)))


def with_pictures_of(sample, other):
    """The sample, where frame ``i`` has the picture of frame ``other(i)``."""
    greys = [f.grey for f in sample.frames]
    frames = [
        dataclasses.replace(f, grey=greys[other(i) % len(greys)])
        for i, f in enumerate(sample.frames)
    ]
    return dataclasses.replace(sample, frames=frames)


def test_own_pictures(sample):
    assert unrelated_pictures(sample, 0) is None


def test_pictures_in_another_order(sample):
    mixed = with_pictures_of(sample, lambda i: 7 * i + 3)
    finding = unrelated_pictures(mixed, 0)
    assert finding is not None
    assert (finding.name, finding.verdict) == ("registration", "wrong")
    assert "those of other frames" in finding.sentence


def test_late_pictures_are_no_other_ones_once_they_are_moved(sample):
    late = with_pictures_of(sample, lambda i: max(0, i - 6))
    assert unrelated_pictures(late, 6) is None
    moved = with_pictures_of(sample, lambda i: 7 * i + 3)
    assert unrelated_pictures(moved, 6) is not None


def test_where_nothing_moves_nothing_is_said(sample):
    standing = dataclasses.replace(
        sample,
        frames=[
            dataclasses.replace(sample.frames[0], place=i, number=i)
            for i in range(len(sample.frames))
        ],
    )
    assert unrelated_pictures(standing, 0) is None
    assert unrelated_pictures(dataclasses.replace(sample, frames=sample.frames[:1]), 0) is None


def test_the_measure_is_that_of_a_run():
    walk = room(n_frames=200, width=80, height=60)
    frames = [walk[i] for i in range(12)]
    small = [SmallFrame.of(f) for f in frames]
    poses = [f.T_WC for f in frames]
    assert colour_difference(small, poses) == agreement_of(small, poses).colour
    assert math.isnan(colour_difference(small[:1], poses[:1]))
